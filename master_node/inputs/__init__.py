"""External inputs: tables, functions and recorded signals."""
