"""The websocket stream: hub, message log, subscriptions, wire encoding."""
