"""What METRICS.md defines, paragraph by paragraph; `evaluation.evaluate` composes it."""
