"""Ways to solve the damped normal equations, each by what it eliminates."""
