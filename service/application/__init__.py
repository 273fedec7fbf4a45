"""The application: middleware, routers and everything that runs beside them."""
