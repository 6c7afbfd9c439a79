"""Lights objects of `prtbake export ASSET -o X.glb` in Blender: import X.glb, then run this script.

The light is that of the sun objects and of the world's environment picture (.hdr, .exr); without both, that of the
file. Run it again when the light has changed or an object was turned. Cycles takes view degrees to 6, EEVEE to 3.
"""

import bpy
import numpy as np

TO_GLTF = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's importer turns positions, not attributes


def harmonics(directions, degree):
    """Return Y [N,R] of directions [N,3], index l(l+1)+m, orthonormal, no Condon-Shortley phase."""
    (x, y, z), found = np.transpose(directions), np.zeros((len(directions), (degree + 1) ** 2))
    turn, first = np.ones(len(x), complex), np.sqrt(0.25 / np.pi)
    for m in range(degree + 1):
        before, now = 0, first * (np.sqrt(2) if m else 1)
        for l in range(m, degree + 1):
            found[:, l * (l + 1) - m], found[:, l * (l + 1) + m] = now * turn.imag, now * turn.real
            a, b = (4 * (l + 1) ** 2 - 1) / ((l + 1) ** 2 - m**2), (l**2 - m**2) / max(4 * l**2 - 1, 1)
            before, now = now, np.sqrt(a) * (z * now - np.sqrt(b) * before)
        turn, first = turn * (x + 1j * y), first * np.sqrt((2 * m + 3) / (2 * m + 2))
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


def light_of(thing, about, to_object):
    """Return the light [K,3] in object space."""
    if about["quantity"] == "radiance":
        return np.ones((1, 3))
    turn = np.linalg.inv(np.array(thing.matrix_world.to_3x3())).T @ to_object.T
    turn /= np.cbrt(abs(np.linalg.det(turn)))
    of_scene = [harmonics(to @ turn, about["light_degree"]).T @ rgb for to, rgb in lights(bpy.context.scene)]
    return sum(of_scene) if of_scene else np.array([list(rgb) for rgb in about["light"]["coefficients"]])


def powers(degree):
    """Return exponents of x, y, z: these (degree + 1)² products and the harmonics span the same functions."""
    return [(a, b, c) for c in (0, 1) for a in range(degree + 1 - c) for b in range(degree + 1 - c - a)]


def fold(thing, about, to_object):
    """Store the factor of each product, folded with the light, four to an attribute: EEVEE takes at most 15."""
    mesh, degree, light = thing.data, about["view_degree"], light_of(thing, about, to_object)
    values, folded = np.empty((len(mesh.vertices), 3), np.float32), np.zeros(((degree + 1) ** 2, len(mesh.vertices), 3))
    for r, k in np.ndindex(len(folded), len(light)):
        name = about["attributes"].format(r=r, k=k)
        if name not in mesh.attributes:
            raise RuntimeError(f"{thing.name}: no attribute {name}; Blender drops int8: export without --quantize")
        mesh.attributes[name].data.foreach_get("vector", values.reshape(-1))
        folded[r] += values * light[k]
    around = np.random.default_rng(0).normal(size=(4 * len(folded), 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    products = np.stack([np.prod(around**power, axis=1) for power in powers(degree)], axis=1)
    change = np.linalg.lstsq(products, harmonics(around, degree), rcond=None)[0]
    factors = np.pad(np.tensordot(change, folded, 1), ((0, -len(folded) % 4), (0, 0), (0, 0)))
    for c, j in np.ndindex(3, len(factors) // 4):
        name = f"prtbake_{c}_{j}"
        stored = mesh.attributes.get(name) or mesh.attributes.new(name, "FLOAT_COLOR", "POINT")
        stored.data.foreach_set("color", factors[4 * j : 4 * j + 4, :, c].T.astype(np.float32).ravel())
    mesh.update()


def add(tree, kind, *inputs, **settings):
    """Add a node to a tree and return its outputs."""
    node = tree.nodes.new("ShaderNode" + kind)
    for name, value in settings.items():
        setattr(node, name, value)
    for socket, value in zip(node.inputs, inputs, strict=False):
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return node.outputs


def shade(tree, degree, to_object):
    """Fill a node tree: emission of the sum of products and factors, at least 0."""
    tree.nodes.clear()
    incoming = add(tree, "NewGeometry")["Incoming"]
    eye = add(tree, "VectorTransform", incoming, vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT")[0]
    along = [add(tree, "VectorMath", eye, row, operation="DOT_PRODUCT")["Value"] for row in to_object]
    eye = add(tree, "VectorMath", add(tree, "CombineXYZ", *along)[0], operation="NORMALIZE")[0]  # a node may be scaled
    axes = list(add(tree, "SeparateXYZ", eye))
    found = {(0, 0, 0): 1.0}
    for power in powers(degree)[1:]:
        axis = next(axis for axis in range(3) if power[axis])
        less = tuple(one - (axis == other) for other, one in enumerate(power))
        found[power] = add(tree, "Math", found[less], axes[axis], operation="MULTIPLY")[0]
    products, total = [*found.values(), 0.0, 0.0, 0.0], (0.0, 0.0, 0.0)
    for j in range(-(-len(found) // 4)):
        three, channels = add(tree, "CombineXYZ", *products[4 * j : 4 * j + 3])[0], []
        for c in range(3):
            factors = add(tree, "Attribute", attribute_name=f"prtbake_{c}_{j}")
            dot = add(tree, "VectorMath", factors["Color"], three, operation="DOT_PRODUCT")["Value"]
            channels.append(add(tree, "Math", factors["Alpha"], products[4 * j + 3], dot, operation="MULTIPLY_ADD")[0])
        total = add(tree, "VectorMath", total, add(tree, "CombineXYZ", *channels)[0], operation="ADD")[0]
    radiance = add(tree, "VectorMath", total, (0.0, 0.0, 0.0), operation="MAXIMUM")[0]
    add(tree, "OutputMaterial", add(tree, "Emission", radiance)[0])


def main():
    """Light all objects of prtbake in the scene."""
    things = [thing for thing in bpy.context.scene.objects if thing.type == "MESH" and "prtbake" in thing.data]
    if not things:
        raise RuntimeError("no object of `prtbake export` in this scene: import its .glb first")
    bpy.context.view_layer.update()
    for thing in things:
        about = thing.data["prtbake"]
        if about["view_degree"] > 6:
            raise RuntimeError(f"{thing.name}: Cycles has no room for so many numbers: export with --degree 6 or less")
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
