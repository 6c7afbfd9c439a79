## Shows a file of `prtbake export ASSET -o X.glb` and lights it. The node may be moved, turned, mirrored and scaled uniformly.
extends Node3D

const File := preload("prtbake_file.gd")
const GOLDEN := 1.618034

@export_file("*.glb") var file := "res://object.glb" ## In the Import dock: "Keep File (exported as is)".
@export var suns: Array[DirectionalLight3D] ## Their direction, colour and energy.
## Nine coefficients in world space: `prtbake light SKY --up y --json`. Without these and suns, the light of the file.
@export var sky: PackedVector3Array


func _ready() -> void:
	var scene := File.read(file)
	if scene:
		add_child(scene)


func _process(_delta: float) -> void:
	for instance: MeshInstance3D in find_children("*", "MeshInstance3D", true, false):
		if instance.has_meta("prtbake"):
			_light(instance, instance.get_meta("prtbake"))


func _light(instance: MeshInstance3D, about: Dictionary) -> void:
	var m: Array = about["local_to_object"]
	var local := Basis(Vector3(m[0], m[3], m[6]), Vector3(m[1], m[4], m[7]), Vector3(m[2], m[5], m[8]))
	var turn := (local * instance.global_basis.inverse()).orthonormalized()
	var b: PackedVector3Array = []
	for row: Array in about["light"]["coefficients"]:
		b.append(Vector3(row[0], row[1], row[2]))
	if about["quantity"] == "radiance":
		b = [Vector3.ONE]
	elif suns or sky:
		b.fill(Vector3.ZERO)
		for sun in suns:
			var colour := sun.light_color.srgb_to_linear() * sun.light_energy * PI
			_add(b, turn * sun.global_basis.z.normalized(), Vector3(colour.r, colour.g, colour.b))
		for corner in 12 if sky else 0: # the corners of an icosahedron integrate polynomials of degree 5 exactly
			var one := Vector3(0.0, -1.0 if corner & 1 else 1.0, -GOLDEN if corner & 2 else GOLDEN).normalized()
			one = [one, Vector3(one.y, one.z, one.x), Vector3(one.z, one.x, one.y)][corner / 4]
			var radiance := Vector3.ZERO
			for k in 9:
				radiance += _harmonics(one)[k] * sky[k]
			_add(b, turn * one, radiance * TAU / 6.0)
	instance.material_override.set_shader_parameter("light", b)
	instance.material_override.set_shader_parameter("to_object", local)


func _add(b: PackedVector3Array, direction: Vector3, irradiance: Vector3) -> void:
	var y := _harmonics(direction)
	for k in mini(b.size(), 9):
		b[k] += y[k] * irradiance


func _harmonics(d: Vector3) -> PackedFloat32Array:
	return [
		0.282095, 0.488603 * d.y, 0.488603 * d.z, 0.488603 * d.x, 1.092548 * d.x * d.y, 1.092548 * d.y * d.z,
		0.315392 * (3.0 * d.z * d.z - 1.0), 1.092548 * d.x * d.z, 0.546274 * (d.x * d.x - d.y * d.y)]
