"""What the method is worth, and why: the paper's figures with ours beside them; run by `crowdmap study`."""
