## Reads a file of `prtbake export ASSET -o X.glb`: its scene, whose meshes have their transport as a texture.

const SHADER := preload("prtbake.gdshader")


static func read(path: String) -> Node:
	var document := GLTFDocument.new()
	var state := GLTFState.new()
	if not FileAccess.file_exists(path) or document.append_from_file(path, state) != OK:
		push_error(path + ": expected a GLB; choose 'Keep File (exported as is)' in the Import dock")
		return null
	var scene := document.generate_scene(state)
	for index in state.meshes.size():
		var record: Dictionary = state.json["meshes"][index]
		var about: Dictionary = record.get("extras", {}).get("prtbake", {})
		for instance: MeshInstance3D in scene.find_children("*", "MeshInstance3D", true, false):
			if about and instance.mesh == state.meshes[index].mesh.get_mesh():
				instance.set_meta("prtbake", about)
				instance.material_override = _material(state, record["primitives"], instance.mesh, about)
	return scene


static func _material(state: GLTFState, primitives: Array, mesh: Mesh, about: Dictionary) -> ShaderMaterial:
	var size := Vector2i(about["texels"]["width"], about["texels"]["height"])
	var int8: bool = about["quantize"] == "int8"
	var columns := 1 if about["quantity"] == "radiance" else int((about["light_degree"] + 1) ** 2)
	var layers: Array[Image] = []
	var texels: Array[PackedInt32Array] = [] # of the vertices of each surface
	for surface in primitives.size():
		texels.append(PackedInt32Array())
		for uv in mesh.surface_get_arrays(surface)[Mesh.ARRAY_TEX_UV2]:
			texels[surface].append(int(uv.y * size.y) * size.x + int(uv.x * size.x))
	for layer in int((about["view_degree"] + 1) ** 2) * columns:
		var bytes := PackedByteArray()
		bytes.resize(size.x * size.y * (4 if int8 else 12))
		for surface in primitives.size():
			var name: String = about["attributes"].format({"r": layer / columns, "k": layer % columns})
			_copy(state, primitives[surface]["attributes"][name], texels[surface], 1 if int8 else 3, bytes)
		var format := Image.FORMAT_RGBA8 if int8 else Image.FORMAT_RGBF
		layers.append(Image.create_from_data(size.x, size.y, false, format, bytes))
	var material := ShaderMaterial.new()
	material.shader = SHADER
	var transfer := Texture2DArray.new()
	transfer.create_from_images(layers)
	var values := {"transfer": transfer, "int8": int8, "columns": columns, "view_degree": int(about["view_degree"])}
	for uniform: String in values:
		material.set_shader_parameter(uniform, values[uniform])
	return material


## Copies an attribute, some words of 4 bytes for each vertex, to the texels of the vertices.
static func _copy(state: GLTFState, index: int, texels: PackedInt32Array, words: int, bytes: PackedByteArray) -> void:
	var accessor: Dictionary = state.json["accessors"][index]
	var view: GLTFBufferView = state.buffer_views[accessor["bufferView"]]
	var source := view.load_buffer_view_data(state).slice(int(accessor.get("byteOffset", 0)))
	var stride := view.byte_stride / 4 if view.byte_stride > 0 else words
	for vertex in texels.size():
		for word in words:
			bytes.encode_u32(4 * (words * texels[vertex] + word), source.decode_u32(4 * (stride * vertex + word)))
