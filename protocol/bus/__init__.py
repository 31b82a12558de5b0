"""Buses: in process and over Zenoh, with endpoints, credentials and access."""
