"""Case peak-efficiency: position estimators against the Cramer-Rao bound."""
