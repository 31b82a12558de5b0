"""``slave-node validate`` and ``inspect``: what a model can do, in words."""
