"""Maps in the formats of others, one module a format; `export.export_map` chooses among them."""
