"""The service's database: typed models, engine and transactions, migrations, first content."""
