"""What people walk around in: one offline HTML file with a map, the drives it was made of, and what they saw."""
