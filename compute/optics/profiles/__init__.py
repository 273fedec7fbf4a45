"""Device profiles: published and assumed parameters of a device in one TOML file."""
