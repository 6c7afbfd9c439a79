## Shows main.tscn under the situations of job.json and hands their pictures to the page.
extends Node


func _ready() -> void:
	var pictures := []
	for job: Dictionary in JSON.parse_string(FileAccess.get_file_as_string("res://job.json")):
		pictures.append(await _picture(job))
	JavaScriptBridge.eval("window.pictures = %s" % JSON.stringify(pictures))


func _picture(job: Dictionary) -> String:
	var main: Node3D = load("res://main.tscn").instantiate()
	var object: Node3D = main.get_node("Object")
	var sun: DirectionalLight3D = main.get_node("Sun")
	var camera: Camera3D = main.get_node("Camera")
	object.file = job["glb"]
	object.rotation_degrees.y = job["turn"]
	object.scale.z = -1.0 if job["mirrored"] else 1.0
	for row: Array in job["sky"]:
		object.sky.append(_vector(row))
	if job["sun"]:
		sun.light_energy = job["energy"]
		sun.light_color = Color(job["colour"][0], job["colour"][1], job["colour"][2]).linear_to_srgb()
	else:
		object.suns.clear()
	add_child(main)
	sun.look_at(-_vector(job["sun"]) if job["sun"] else Vector3.FORWARD)
	camera.fov = job["fov"]
	camera.look_at_from_position(_vector(job["eye"]), _vector(job["target"]))
	for frame in 3:
		await RenderingServer.frame_post_draw
	var picture := get_viewport().get_texture().get_image()
	picture.convert(Image.FORMAT_RGB8)
	main.free()
	return Marshalls.raw_to_base64(picture.get_data())


func _vector(row: Array) -> Vector3:
	return Vector3(row[0], row[1], row[2])
