"""Signs of one drive: triangulation (IV-B)."""
