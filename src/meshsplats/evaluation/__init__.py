"""How good images are: metrics, scores on held-out views, comparisons and benchmark protocols."""
