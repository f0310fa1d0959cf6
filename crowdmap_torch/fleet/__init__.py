"""Where work runs: in this process, in processes beside it, or on a Ray cluster; whatever a worker loses is done again."""
