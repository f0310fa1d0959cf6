"""Times and figures beside other ways to do the same; run by `crowdmap benchmark`."""
