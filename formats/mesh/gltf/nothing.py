"""Why a glTF file shows no triangle."""

from collections.abc import Collection

from formats.mesh.gltf.container import GltfFile
from formats.mesh.gltf.nodes import Forest


def why_nothing_is_shown(file: GltfFile, forest: Forest, visible: Collection[int]) -> str:
    """Return why the `visible` nodes of the default scene have no triangle, and what to do."""
    nodes, meshes = file.records.nodes, file.records.meshes
    with_mesh = [index for index, node in enumerate(nodes) if node.mesh is not None]
    if not meshes or set(with_mesh) & set(visible):
        return "has no faces; expected triangles in its scene, export the object as a triangle mesh"
    if not with_mesh:
        return (
            f"no node shows a mesh, though the file has {len(meshes)}; add the object to the scene, and export it again"
        )
    hidden = _hidden(file)
    others = [index for index in with_mesh if index not in hidden]
    if not others:
        first = file.node(with_mesh[0])
        found = f"all {len(with_mesh)} nodes with meshes, the first is {first}, are"
        found = found if len(with_mesh) > 1 else f"{first}, the only node with a mesh, is"
        return f"{found} hidden by KHR_node_visibility; make the object visible, and export the file again"
    place = _scene_of(file, forest, others[0])
    return (
        f"the default scene shows no mesh, but {file.node(others[0])} in {place} has one; "
        f"add the object to the default scene, and export the file again"
    )


def _hidden(file: GltfFile) -> set[int]:
    """Return the nodes that are not visible, and their descendants."""
    nodes = file.records.nodes
    hidden = set[int]()
    pending = [index for index, node in enumerate(nodes) if not node.extensions.KHR_node_visibility.visible]
    while pending:
        index = pending.pop()
        if index not in hidden:
            hidden.add(index)
            pending += nodes[index].children
    return hidden


def _scene_of(file: GltfFile, forest: Forest, index: int) -> str:
    """Return the place of the first scene that has a node."""
    while forest.parents[index] >= 0:
        index = forest.parents[index]
    scenes = (number for number, scene in enumerate(file.records.scenes) if index in scene.nodes)
    return next((f"scenes[{number}]" for number in scenes), "no scene")
