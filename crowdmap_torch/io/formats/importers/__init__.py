"""Other people's files read, one module a format: `NAME.py` has an `IMPORTER`; `composing.registry` finds it by name.

Other packages bring theirs by entry points of the group `crowdmap_torch.importers`, each naming such an object.
"""
