"""What METRICS.md defines, paragraph by paragraph; `crowdmap_torch.evaluate` composes it."""
