"""The markers' section of a first ``robot.yaml``."""

from __future__ import annotations

from fgloc.sensors.first_settings import FirstLook, FirstSection, FirstSettings


def section(look: FirstLook) -> FirstSection:
    """Dictionary and size, as far as the images show them."""
    if "image" not in look.roles:
        return FirstSection()
    from fgloc.sensors.markers.hints import fitting_dictionary  # OpenCV takes a while to load

    lines, missing = ["markers:"], []
    dictionary = fitting_dictionary(look.recording)
    if dictionary is not None:
        lines.append(f"  dictionary: {dictionary}  # what is seen in the images fits it")
    else:
        lines.append("  # dictionary: DICT_4X4_50")
        missing.append("the dictionary of the markers: no marker was found in the images (markers.dictionary)")
    if look.has_map:
        lines.append("  # default_size_m:  # the map beside the bag has the sizes")
    else:
        lines.append("  # default_size_m: 0.16  # side of the black square; every distance follows from it")
        missing.append(
            "the size of the markers: measure the side of the black square and give it (markers.default_size_m)"
        )
    lines.append("  sigma_px: 0.1  # of a corner: 0.1 for a sharp camera, 0.3 for one that shakes")
    if "camera_info" not in look.roles:
        lines += [
            "",
            "# The recording has no CameraInfo:",
            "# camera: {file: camera.yaml}  # as camera_calibration writes it",
        ]
    return FirstSection(tuple(lines), tuple(missing))


FIRST_SETTINGS = FirstSettings((), section)
