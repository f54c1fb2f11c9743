"""Sensors to measurements: wheels, markers in images (the only cv2 importer), marker maps, camera files."""
