"""The broker: sessions, routing and delivery. Pure and synchronous; time is an argument."""
