"""Signs of many drives: clusters, biases, and what became of each detection (V-A.1, V-B)."""
