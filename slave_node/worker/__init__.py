"""The process that holds a model, and the pipe on which it is driven."""
