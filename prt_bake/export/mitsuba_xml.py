"""Writes a Mitsuba dictionary as an XML scene file.

Own code, because Mitsuba 3.9 cannot write scene files and an export must not need Mitsuba.
"""

import os
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.scene import Scene
from prt_bake.export.mitsuba import ENDINGS, mitsuba_dictionary
from prt_bake.geometry.camera import Camera, fit

_VERSION = "3.0.0"
_KINDS = {
    **dict.fromkeys(("volpath", "volpathmis"), "integrator"),
    **dict.fromkeys(("constant", "directional"), "emitter"),
    **dict.fromkeys(("homogeneous", "heterogeneous"), "medium"),
    **dict.fromkeys(("constvolume", "gridvolume"), "volume"),
    **dict.fromkeys(("null", "dielectric", "roughdielectric", "twosided", "diffuse"), "bsdf"),
    **{"hg": "phase", "ply": "shape", "bitmap": "texture", "scene": "scene"},
}


def exported_files(scene: Scene, folder: str | os.PathLike[str]) -> list[Path]:
    """Return the paths of all files that an export of the scene into `folder` may write."""
    parts = (f"part_{index}{ending}" for index in range(len(scene.parts)) for ending in ENDINGS)
    return [Path(folder, name) for name in ("scene.xml", *parts)]


def write_mitsuba_scene(scene: Scene, folder: str | os.PathLike[str]) -> Path:
    """Write `scene.xml` and its files into an existing folder, lit by a white environment; return the path.

    The scene is centred as by `mitsuba_dictionary`; the camera is the default one of `prtbake render`.

    Raises:
        SceneError, StorageError: as `mitsuba_dictionary`.
    """
    target = Path(folder)
    root = _element("", mitsuba_dictionary(scene, target))
    root.attrib = {"version": _VERSION}
    root.append(_sensor(fit(scene.mesh, up=scene.up), scene))
    # File names are relative to the scene file, so that the folder can be moved.
    for named in root.iter("string"):
        if named.get("name") == "filename":
            named.set("value", Path(named.attrib["value"]).name)
    ET.indent(root)
    path = target / "scene.xml"
    with replacing(path) as part_path:
        ET.ElementTree(root).write(part_path, encoding="utf-8", xml_declaration=True)
    return path


def _element(name: str, value: Any) -> ET.Element:
    """Convert one entry of a dictionary."""
    if isinstance(value, dict):
        return _plugin(name, value)
    if isinstance(value, bool):
        return _number("boolean", name, str(value).lower())
    if isinstance(value, list):
        return _number("vector", name, ", ".join(map(repr, value)))
    kind = {int: "integer", float: "float", str: "string"}[type(value)]
    return _number(kind, name, str(value))


def _plugin(name: str, plugin: dict[str, Any]) -> ET.Element:
    kind = plugin["type"]
    if kind == "ref":
        return ET.Element("ref", {"name": name, "id": plugin["id"]})
    if kind == "rgb":
        return _number("rgb", name, ", ".join(map(repr, plugin["value"])))
    element = ET.Element(_KINDS[kind], {"type": kind, "name": name})
    if name.startswith("medium_"):
        element.attrib = {"type": kind, "id": name}
    for key, value in plugin.items():
        if key != "type":
            element.append(_element(key, value))
    return element


def _number(kind: str, name: str, value: str) -> ET.Element:
    return ET.Element(kind, {"name": name, "value": value})


def _sensor(camera: Camera, scene: Scene) -> ET.Element:
    sensor = ET.Element("sensor", {"type": "perspective"})
    sensor.append(_element("fov", camera.fov))
    sensor.append(_element("fov_axis", "y"))
    for name, distance in (("near_clip", 1e-3), ("far_clip", 1e3)):
        sensor.append(_element(name, float(distance * scene.mesh.diagonal)))
    place = ET.SubElement(sensor, "transform", {"name": "to_world"})
    points = {
        "origin": camera.eye - scene.mesh.center,
        "target": camera.target - scene.mesh.center,
        "up": camera.up,
    }
    ET.SubElement(place, "lookat", {name: ", ".join(map(repr, p.tolist())) for name, p in points.items()})
    film = ET.SubElement(sensor, "film", {"type": "hdrfilm"})
    film.append(_element("width", camera.width))
    film.append(_element("height", camera.height))
    return sensor
