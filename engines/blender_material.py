"""Lights objects of `prtbake export ASSET -o X.glb` in Blender: import X.glb, then run this script.

The light is that of the sun objects and of the world's environment picture (.hdr, .exr); without both, that of the
file. Run it again when the light has changed or an object was turned. Cycles takes any view degree, EEVEE up to 3.
"""

import bpy
import numpy as np

TO_GLTF = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's importer turns positions, not attributes


class Number:
    """An output of a node; arithmetic adds nodes."""

    def __init__(self, socket):
        self.socket = socket

    def __add__(self, other):
        return add_node(self.socket.id_data, "Math", self, other, operation="ADD")[0]

    def __sub__(self, other):
        return add_node(self.socket.id_data, "Math", self, other, operation="SUBTRACT")[0]

    def __mul__(self, other):
        return add_node(self.socket.id_data, "Math", self, other, operation="MULTIPLY")[0]


def add_node(tree, kind, *inputs, **settings):
    """Add a node to a tree and return its outputs."""
    node = tree.nodes.new("ShaderNode" + kind)
    for name, value in settings.items():
        setattr(node, name, value)
    for socket, value in zip(node.inputs, inputs, strict=False):
        if isinstance(value, Number):
            tree.links.new(value.socket, socket)
        else:
            socket.default_value = value
    return [Number(socket) for socket in node.outputs]


def harmonics(x, y, z, degree):
    """Return Y by index l(l+1)+m, orthonormal, no Condon-Shortley phase, of unit directions: arrays or nodes."""
    found, cosine, sine, first = [None] * (degree + 1) ** 2, x * 0 + 1, x * 0, 0.5 / np.sqrt(np.pi)
    for m in range(degree + 1):
        before, now = x * 0, x * 0 + first * (np.sqrt(2) if m else 1)
        for n in range(m, degree + 1):
            found[n * (n + 1) - m], found[n * (n + 1) + m] = now * sine, now * cosine
            a = np.sqrt((4 * (n + 1) ** 2 - 1) / ((n + 1) ** 2 - m**2))
            before, now = now, (now * z - before * np.sqrt((n**2 - m**2) / abs(4 * n**2 - 1))) * a
        cosine, sine, first = x * cosine - y * sine, x * sine + y * cosine, first * np.sqrt((2 * m + 3) / (2 * m + 2))
    return found


def lights(scene):
    """Yield directions [N,3] to lights in the world, and their radiance times solid angle [N,3]."""
    for sun in scene.objects:
        if sun.type == "LIGHT" and sun.data.type == "SUN" and not sun.hide_render:
            towards = np.array(sun.matrix_world.to_quaternion().to_matrix())[None, :, 2]
            yield towards, sun.data.energy * np.array([sun.data.color])
    nodes = {node.type: node for node in scene.world.node_tree.nodes} if scene.world and scene.world.use_nodes else {}
    if "TEX_ENVIRONMENT" in nodes:
        image, strength = nodes["TEX_ENVIRONMENT"].image, nodes["BACKGROUND"].inputs["Strength"].default_value
        turn = nodes["MAPPING"].inputs["Rotation"].default_value.to_matrix() if "MAPPING" in nodes else np.eye(3)
        (width, height), pixels = image.size, np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(pixels)
        phi = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
        for row, line in enumerate(pixels.reshape(height, width, -1)):  # the first row is the lowest
            low, z, high = -np.cos(np.pi * (row + np.array([0, 0.5, 1])) / height)
            flat = np.sqrt(1 - z * z)
            directions = np.stack([flat * np.cos(phi), flat * np.sin(phi), np.full(width, z)], axis=1)
            yield directions @ np.array(turn), line[:, :3] * (strength * (high - low) * 2 * np.pi / width)


def fold(thing, about, to_object):
    """Store Σ_k A[v,r,k] b[k] as attributes of four numbers for each channel: EEVEE has at most 15 attributes."""
    mesh, count = thing.data, (about["view_degree"] + 1) ** 2
    turn = to_object @ np.array(thing.matrix_world.to_quaternion().to_matrix()).T
    if about["quantity"] == "radiance":
        light = np.ones((1, 3))
    elif scene_lights := list(lights(bpy.context.scene)):
        light = sum(np.array(harmonics(*(turn @ to.T), about["light_degree"])) @ rgb for to, rgb in scene_lights)
    else:
        light = np.array([list(rgb) for rgb in about["light"]["coefficients"]])
    folded, values = np.zeros((len(mesh.vertices), count + -count % 4, 3)), np.empty(3 * len(mesh.vertices), np.float32)
    for r, k in np.ndindex(count, len(light)):
        name = about["attributes"].format(r=r, k=k)
        if name not in mesh.attributes:
            raise RuntimeError(f"{thing.name}: no attribute {name}; Blender drops int8: export without --quantize")
        mesh.attributes[name].data.foreach_get("vector", values)
        folded[:, r] += values.reshape(-1, 3) * light[k]
    for c, j in np.ndindex(3, folded.shape[1] // 4):
        name = f"prtbake_{c}_{j}"
        stored = mesh.attributes.get(name) or mesh.attributes.new(name, "FLOAT_COLOR", "POINT")
        stored.data.foreach_set("color", folded[:, 4 * j : 4 * j + 4, c].astype(np.float32).ravel())
    mesh.update()


def shade(tree, degree, to_object):
    """Fill a node tree with max(0, Σ_r Y_r(ωo) folded_r)."""
    tree.nodes.clear()
    incoming = add_node(tree, "NewGeometry")[4]
    spaces = {"vector_type": "VECTOR", "convert_from": "WORLD", "convert_to": "OBJECT"}
    local = add_node(tree, "VectorTransform", incoming, **spaces)[0]
    eye = add_node(tree, "VectorMath", local, operation="NORMALIZE")[0]
    x, y, z = (add_node(tree, "VectorMath", eye, row, operation="DOT_PRODUCT")[1] for row in to_object)
    values, channels = harmonics(x, y, z, degree), []
    values += [x * 0] * (-len(values) % 4)
    threes = [add_node(tree, "CombineXYZ", *values[i : i + 3])[0] for i in range(0, len(values), 4)]
    for c in range(3):
        total = x * 0
        for j, three in enumerate(threes):
            color, _, _, alpha = add_node(tree, "Attribute", attribute_name=f"prtbake_{c}_{j}")
            dot = add_node(tree, "VectorMath", color, three, operation="DOT_PRODUCT")[1]
            total = total + dot + alpha * values[4 * j + 3]
        channels.append(add_node(tree, "Math", total, 0.0, operation="MAXIMUM")[0])
    add_node(tree, "OutputMaterial", add_node(tree, "Emission", add_node(tree, "CombineXYZ", *channels)[0])[0])


def main():
    """Light all objects of prtbake in the scene."""
    things = [thing for thing in bpy.context.scene.objects if thing.type == "MESH" and "prtbake" in thing.data]
    if not things:
        raise RuntimeError("no object of `prtbake export` in this scene: import its .glb first")
    bpy.context.view_layer.update()
    for thing in things:
        about = thing.data["prtbake"]
        to_object = np.array(about["local_to_object"]).reshape(3, 3) @ TO_GLTF
        if thing.data.users > 1:
            thing.data = thing.data.copy()  # another object with this mesh may be turned otherwise
        fold(thing, about, to_object)
        name = f"prtbake {thing.data.name}"
        material = bpy.data.materials.get(name) or bpy.data.materials.new(name)
        material.use_nodes = True
        shade(material.node_tree, about["view_degree"], to_object)
        thing.data.materials.clear()
        thing.data.materials.append(material)


main()
