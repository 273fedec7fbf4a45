"""Single sensor."""
