"""The coupled system: connections with units and types, order of feed-through, step sizes."""
