"""Programs of other solvers, run as files in processes of their own."""
