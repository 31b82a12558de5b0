"""How the state of a slave is saved when its model cannot, or shall not, do it itself."""
