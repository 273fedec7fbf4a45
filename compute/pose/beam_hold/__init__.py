"""Beam hold: monitors of a pose or markers against limits, and the state machine of the hold."""
