"""A program for the Python of Blender: renders pictures of exported files that `engines/blender_material.py` lights.

python blender_scene.py JOBS.json, a list of objects with the keys
glb: the file; attributes: a .npz for what was imported; picture: an .exr
camera: eye, target [3] in Blender's world, and fov in degrees
light: {} for that of the file, {"sky": path, "turn": degrees}, or {"sun": direction, "irradiance": [3]}
turn: of the object about z, degrees; engine: CYCLES, or BLENDER_EEVEE_NEXT
"""

import json
import math
import runpy
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

SCRIPT = str(Path(__file__).parents[2] / "engines" / "blender_material.py")
PIXELS = 128


def main(jobs: str) -> None:
    for job in json.loads(Path(jobs).read_text()):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.import_scene.gltf(filepath=job["glb"])
        (thing,) = (one for one in bpy.data.objects if one.type == "MESH")
        np.savez(job["attributes"], **attributes_of(thing.data))
        thing.rotation_mode = "QUATERNION"
        bpy.context.view_layer.update()
        thing.matrix_world = Matrix.Rotation(math.radians(job["turn"]), 4, "Z") @ thing.matrix_world
        add_camera(**job["camera"])
        add_light(job["light"])
        runpy.run_path(SCRIPT, run_name="__main__")
        runpy.run_path(SCRIPT, run_name="__main__")  # a second run changes nothing
        render(job["engine"], job["picture"])


def attributes_of(mesh: "bpy.types.Mesh") -> "dict[str, np.ndarray]":
    found = {}
    for attribute in mesh.attributes:
        if attribute.name.startswith("_PRT") or attribute.name == "position":
            values = np.empty(3 * len(attribute.data), np.float32)
            attribute.data.foreach_get("vector", values)
            found[attribute.name] = values.reshape(-1, 3)
    return found


def add_camera(eye: "list[float]", target: "list[float]", fov: float) -> None:
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.angle_y, data.clip_start = "VERTICAL", math.radians(fov), 1e-3
    camera = bpy.data.objects.new("camera", data)
    turn = (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    camera.matrix_world = Matrix.Translation(eye) @ turn
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera


def add_light(light: "dict") -> None:
    scene = bpy.context.scene
    if "sun" in light:
        data = bpy.data.lights.new("sun", "SUN")
        data.energy = max(light["irradiance"])
        data.color = [one / data.energy for one in light["irradiance"]]
        sun = bpy.data.objects.new("sun", data)
        sun.matrix_world = Vector(light["sun"]).to_track_quat("Z", "Y").to_matrix().to_4x4()
        scene.collection.objects.link(sun)
    if "sky" in light:
        scene.world = bpy.data.worlds.new("world")
        scene.world.use_nodes = True
        tree = scene.world.node_tree
        sky, mapping = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeMapping")
        sky.image = bpy.data.images.load(light["sky"])
        mapping.inputs["Rotation"].default_value[2] = math.radians(-light["turn"])  # turns the look-up, not the sky
        tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"], mapping.inputs["Vector"])
        tree.links.new(mapping.outputs[0], sky.inputs[0])
        tree.links.new(sky.outputs[0], tree.nodes["Background"].inputs[0])


def render(engine: str, path: str) -> None:
    scene = bpy.context.scene
    settings = scene.render
    settings.engine, settings.filepath, settings.film_transparent = engine, path, True
    settings.resolution_x = settings.resolution_y = PIXELS
    settings.filter_size = 0.01
    settings.image_settings.file_format, settings.image_settings.color_depth = "OPEN_EXR", "32"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.pixel_filter_type = 16, False, "BOX"
    scene.eevee.taa_render_samples = 16
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(sys.argv[1])
