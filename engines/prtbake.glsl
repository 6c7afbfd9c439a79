// prtbake.glsl: the radiance of a baked object, for GLSL 3.30, 4.x and ES 3.00. Test and uses: README.md beside it.
//     L(v, ωo) = max(0, Σ_r Y_r(ωo) Σ_k A[v,r,k] b[k])
// Directions are unit vectors in object space. b [PRT_K] are the harmonics of the light's radiance.
// prt_to_object: for a stretched or sheared node pass the transposed inverse of its 3×3 matrix, as for normals.
// Define before it, as X.json says: PRT_VIEW_DEGREE ("view_degree"), PRT_LIGHT_DEGREE ("light_degree"). If A is not
// the texture X.exr, also PRT_VERTEX, the type that names a vertex, and PRT_FETCH(vertex, i), its A with i = r·K + k.
#ifndef PRT_VIEW_DEGREE
#define PRT_VIEW_DEGREE 3
#define PRT_LIGHT_DEGREE 2
#endif
#ifndef PRT_FETCH
uniform highp sampler2D prt_texture;
#define PRT_VERTEX ivec2 // the first texel of the vertex
#define PRT_FETCH(vertex, i) texelFetch(prt_texture, vertex + ivec2(i, 0), 0).rgb
#endif
const int PRT_R = (PRT_VIEW_DEGREE + 1) * (PRT_VIEW_DEGREE + 1);
const int PRT_K = (PRT_LIGHT_DEGREE + 1) * (PRT_LIGHT_DEGREE + 1);
const int PRT_DEGREE = max(PRT_VIEW_DEGREE, PRT_LIGHT_DEGREE), PRT_COUNT = (PRT_DEGREE + 1) * (PRT_DEGREE + 1);

// All harmonics up to the higher degree in the direction d: index l(l+1)+m, orthonormal, no Condon-Shortley phase.
void prt_harmonics(vec3 d, out float Y[PRT_COUNT]) {
    vec2 turn = vec2(1.0, 0.0);  // sin^m θ (cos mφ, sin mφ)
    float first = 0.28209479;    // the harmonic (m, m) without turn
    for (int m = 0; m <= PRT_DEGREE; m++) {
        if (m > 0) turn = vec2(d.x * turn.x - d.y * turn.y, d.x * turn.y + d.y * turn.x);
        if (m > 0) first *= sqrt(float(2 * m + 1) / float(m == 1 ? 1 : 2 * m));
        float before = 0.0, now = first, last = 1.0;
        for (int l = m; l <= PRT_DEGREE; l++) {
            Y[l * (l + 1) + m] = now * turn.x;
            if (m > 0) Y[l * (l + 1) - m] = now * turn.y;
            float scale = sqrt(float((2 * l + 1) * (2 * l + 3)) / float((l + 1 - m) * (l + 1 + m)));
            float next = scale * (d.z * now - before / last);
            before = now, now = next, last = scale;
        }
    }
}

vec3 prt_radiance(PRT_VERTEX vertex, vec3 outgoing, vec3 b[PRT_K]) {  // outgoing: from the vertex to the eye
    float Y[PRT_COUNT];
    prt_harmonics(outgoing, Y);
    vec3 radiance = vec3(0.0);
    for (int r = 0; r < PRT_R; r++)
        for (int k = 0; k < PRT_K; k++) radiance += Y[r] * PRT_FETCH(vertex, r * PRT_K + k) * b[k];
    return max(radiance, 0.0);
}

vec3 prt_to_object(mat3 object_to_world, vec3 direction) {  // rotation, uniform scale, mirror
    return normalize(direction * object_to_world);
}

// Light of irradiance E perpendicular to the direction that it comes from. Begin with b = 0, or with a sky's b.
void prt_add_directional(inout vec3 b[PRT_K], vec3 from, vec3 E) {
    float Y[PRT_COUNT];
    prt_harmonics(from, Y);
    for (int k = 0; k < PRT_K; k++) b[k] += E * Y[k];
}

void prt_add_constant(inout vec3 b[PRT_K], vec3 radiance) { b[0] += radiance * 3.5449077; }  // √4π
