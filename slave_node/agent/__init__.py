"""The agent: starts slaves on its host when masters ask for them."""
