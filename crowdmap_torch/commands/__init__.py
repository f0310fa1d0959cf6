"""What the `crowdmap` command can do: each module reads its options, calls the library and shows the result."""
