"""Lane markers of one drive: pieces of natural cubic splines on the road (IV-D)."""
