"""Routes to the descriptor: error against run time, and the growth of sampling."""
