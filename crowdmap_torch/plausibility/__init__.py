"""What looks wrong with a data set before it is mapped: each finding with its likely cause and cure."""
