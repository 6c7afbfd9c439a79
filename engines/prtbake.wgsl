// prtbake.wgsl: the radiance of a baked object, for WebGPU. Test and uses: README.md beside it.
//     L(v, ωo) = max(0, Σ_r Y_r(ωo) Σ_k A[v,r,k] b[k])
// Directions are unit vectors in object space. b [PRT_K] are the harmonics of the light's radiance.
// prt_to_object: for a stretched or sheared node pass the transposed inverse of its 3×3 matrix, as for normals.
// The module that contains it declares what X.json and its own bindings say:
//     const PRT_VIEW_DEGREE = 3;   // "view_degree"
//     const PRT_LIGHT_DEGREE = 2;  // "light_degree"
//     fn prt_fetch(vertex: u32, i: u32) -> vec3f { … }  // A[v,r,k] with i = r·K + k
const PRT_R = (PRT_VIEW_DEGREE + 1) * (PRT_VIEW_DEGREE + 1);
const PRT_K = (PRT_LIGHT_DEGREE + 1) * (PRT_LIGHT_DEGREE + 1);
const PRT_DEGREE = max(PRT_VIEW_DEGREE, PRT_LIGHT_DEGREE);
const PRT_COUNT = (PRT_DEGREE + 1) * (PRT_DEGREE + 1);

// All harmonics up to the higher degree in the direction d: index l(l+1)+m, orthonormal, no Condon-Shortley phase.
fn prt_harmonics(d: vec3f) -> array<f32, PRT_COUNT> {
  var Y: array<f32, PRT_COUNT>;
  var turn = vec2f(1, 0);  // sin^m θ (cos mφ, sin mφ)
  var first = 0.28209479;  // the harmonic (m, m) without turn
  for (var m = 0; m <= PRT_DEGREE; m++) {
    if (m > 0) {
      turn = vec2f(d.x * turn.x - d.y * turn.y, d.x * turn.y + d.y * turn.x);
      first *= sqrt(f32(2 * m + 1) / f32(select(2 * m, 1, m == 1)));
    }
    var before = 0.0;
    var now = first;
    var last = 1.0;
    for (var l = m; l <= PRT_DEGREE; l++) {
      Y[l * (l + 1) + m] = now * turn.x;
      if (m > 0) { Y[l * (l + 1) - m] = now * turn.y; }
      let scale = sqrt(f32((2 * l + 1) * (2 * l + 3)) / f32((l + 1 - m) * (l + 1 + m)));
      let next = scale * (d.z * now - before / last);
      before = now;
      now = next;
      last = scale;
    }
  }
  return Y;
}

fn prt_radiance(vertex: u32, outgoing: vec3f, b: array<vec3f, PRT_K>) -> vec3f {  // outgoing: to the eye
  var light = b;
  var Y = prt_harmonics(outgoing);
  var radiance = vec3f();
  for (var r = 0; r < PRT_R; r++) {
    for (var k = 0; k < PRT_K; k++) { radiance += Y[r] * prt_fetch(vertex, u32(r * PRT_K + k)) * light[k]; }
  }
  return max(radiance, vec3f());
}

fn prt_to_object(object_to_world: mat3x3f, direction: vec3f) -> vec3f {  // rotation, uniform scale, mirror
  return normalize(direction * object_to_world);
}

// Light of irradiance E perpendicular to the direction that it comes from. Begin with b = 0, or with a sky's b.
fn prt_add_directional(b: ptr<function, array<vec3f, PRT_K>>, direction: vec3f, E: vec3f) {
  var Y = prt_harmonics(direction);
  for (var k = 0; k < PRT_K; k++) { (*b)[k] += E * Y[k]; }
}

fn prt_add_constant(b: ptr<function, array<vec3f, PRT_K>>, radiance: vec3f) { (*b)[0] += radiance * 3.5449077; }  // √4π
