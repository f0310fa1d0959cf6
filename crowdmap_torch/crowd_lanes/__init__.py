"""Lane markers of many drives: traced along density ridges of what the drives saw, or clustered (V-A.2)."""
