"""The factor graph: the only gtsam importer."""
