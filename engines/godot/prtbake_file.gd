## Reads a file of `prtbake export ASSET -o X.glb`: its scene, whose meshes have their transport as a texture.

static func read(path: String) -> Node:
	var document := GLTFDocument.new()
	var state := GLTFState.new()
	if not FileAccess.file_exists(path) or document.append_from_file(path, state) != OK:
		push_error(path + ": expected a GLB; choose 'Keep File (exported as is)' in the Import dock")
		return null
	var scene := document.generate_scene(state)
	for index in state.meshes.size():
		var about: Dictionary = state.json["meshes"][index].get("extras", {}).get("prtbake", {})
		if about.get("texel_attribute", "TEXCOORD_1") != "TEXCOORD_1":
			push_error(path + ": expected a mesh with one set of texture coordinates of its own")
		for instance: MeshInstance3D in scene.find_children("*", "MeshInstance3D", true, false):
			if about and instance.mesh == state.meshes[index].mesh.get_mesh():
				instance.set_meta("prtbake", about)
				instance.material_override = _material(state, index, instance.mesh, about)
	return scene


static func _material(state: GLTFState, index: int, mesh: Mesh, about: Dictionary) -> ShaderMaterial:
	var primitives: Array = state.json["meshes"][index]["primitives"]
	var size := Vector2i(about["texels"]["width"], about["texels"]["height"])
	var words := 1 if about.get("quantize") == "int8" else 3 # of 4 bytes, for each vertex
	var degree := int(about["view_degree"])
	var columns := 1 if about["quantity"] == "radiance" else int((about["light_degree"] + 1) ** 2)
	var texels: Array[PackedInt32Array] = [] # of the vertices of each surface
	for surface in primitives.size():
		var uv2 := Array(mesh.surface_get_arrays(surface)[Mesh.ARRAY_TEX_UV2])
		texels.append(PackedInt32Array(uv2.map(func(uv): return int(uv.y * size.y) * size.x + int(uv.x * size.x))))
	var in_order := texels.size() == 1 and texels[0] == PackedInt32Array(range(texels[0].size()))
	var format := Image.FORMAT_RGBA8 if words == 1 else Image.FORMAT_RGBF
	var layers: Array[Image] = []
	var scales: PackedVector3Array = []
	for layer in (degree + 1) ** 2 * columns:
		var name: String = about["attributes"].format({r = layer / columns, k = layer % columns})
		var stored: PackedInt32Array = []
		stored.resize(size.x * size.y * words)
		for surface in primitives.size():
			var accessor: Dictionary = state.json["accessors"][primitives[surface]["attributes"][name]]
			var view: GLTFBufferView = state.buffer_views[accessor["bufferView"]]
			var first := int(accessor.get("byteOffset", 0))
			var source := view.load_buffer_view_data(state).slice(first).to_int32_array()
			var stride := maxi(view.byte_stride / 4, words)
			if in_order and stride == words:
				source.resize(stored.size())
				stored = source
			else:
				for vertex in texels[surface].size():
					for word in words:
						stored[words * texels[surface][vertex] + word] = source[stride * vertex + word]
		layers.append(Image.create_from_data(size.x, size.y, false, format, stored.to_byte_array()))
		var scale: Array = about["scales"][layer / columns][layer % columns] if words == 1 else [1.0, 1.0, 1.0]
		scales.append(Vector3(scale[0], scale[1], scale[2]))
	var transfer := Texture2DArray.new()
	transfer.create_from_images(layers)
	var material := ShaderMaterial.new()
	material.shader = preload("prtbake.gdshader")
	var values := {transfer = transfer, int8 = words == 1, scales = scales, columns = columns, view_degree = degree}
	for uniform: String in values:
		material.set_shader_parameter(uniform, values[uniform])
	return material
