"""Files of others: importers bring them into the form of FORMAT.md, exporters bring maps into theirs."""
