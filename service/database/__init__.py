"""The service's database: models, engine, transactions with their audit log, migrations."""
