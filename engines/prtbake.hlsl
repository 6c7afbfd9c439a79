// prtbake.hlsl: the radiance of a baked object, for Direct3D, Unity and Unreal. Test and uses: README.md beside it.
//     L(v, ωo) = max(0, Σ_r Y_r(ωo) Σ_k A[v,r,k] b[k])
// Directions are unit vectors in object space. b [PRT_K] are the harmonics of the light's radiance.
// prt_to_object: for a stretched or sheared node pass the transposed inverse of its 3×3 matrix, as for normals.
// Define before it, as X.json says: PRT_VIEW_DEGREE ("view_degree"), PRT_LIGHT_DEGREE ("light_degree"). If A is not
// the texture X.exr, also PRT_SOURCE, the type of what holds it, PRT_VERTEX, the type that names a vertex, and
// PRT_FETCH(source, vertex, i), its float3 A with i = r·K + k.
#ifndef PRT_VIEW_DEGREE
#define PRT_VIEW_DEGREE 3
#define PRT_LIGHT_DEGREE 2
#endif
#ifndef PRT_FETCH
#define PRT_SOURCE Texture2D<float4>
#define PRT_VERTEX int2 // the first texel of the vertex
#define PRT_FETCH(source, vertex, i) source.Load(int3(vertex + int2(i, 0), 0)).rgb
#endif
#define PRT_R ((PRT_VIEW_DEGREE + 1) * (PRT_VIEW_DEGREE + 1))
#define PRT_K ((PRT_LIGHT_DEGREE + 1) * (PRT_LIGHT_DEGREE + 1))
#define PRT_COUNT (PRT_R > PRT_K ? PRT_R : PRT_K)

// All harmonics up to the higher degree in the direction d: index l(l+1)+m, orthonormal, no Condon-Shortley phase.
void prt_harmonics(float3 d, out float Y[PRT_COUNT]) {
    float2 turn = float2(1, 0);  // sin^m θ (cos mφ, sin mφ)
    float first = 0.28209479;    // the harmonic (m, m) without turn
    for (int m = 0; m * m < PRT_COUNT; m++) {
        if (m > 0) turn = float2(d.x * turn.x - d.y * turn.y, d.x * turn.y + d.y * turn.x);
        if (m > 0) first *= sqrt(float(2 * m + 1) / float(m == 1 ? 1 : 2 * m));
        float before = 0, now = first, last = 1;
        for (int l = m; l * l < PRT_COUNT; l++) {
            Y[l * (l + 1) + m] = now * turn.x;
            if (m > 0) Y[l * (l + 1) - m] = now * turn.y;
            float scale = sqrt(float((2 * l + 1) * (2 * l + 3)) / float((l + 1 - m) * (l + 1 + m)));
            float next = scale * (d.z * now - before / last);
            before = now, now = next, last = scale;
        }
    }
}

// outgoing: from the vertex to the eye.
float3 prt_radiance(PRT_SOURCE source, PRT_VERTEX vertex, float3 outgoing, float3 b[PRT_K]) {
    float Y[PRT_COUNT];
    prt_harmonics(outgoing, Y);
    float3 radiance = 0;
    for (int r = 0; r < PRT_R; r++)
        for (int k = 0; k < PRT_K; k++) radiance += Y[r] * PRT_FETCH(source, vertex, r * PRT_K + k) * b[k];
    return max(radiance, 0);
}

float3 prt_to_object(float3x3 object_to_world, float3 direction) {  // for mul(object_to_world, x)
    return normalize(mul(direction, object_to_world));
}

// Light of irradiance E perpendicular to the direction that it comes from. Begin with b = 0, or with a sky's b.
void prt_add_directional(inout float3 b[PRT_K], float3 from, float3 E) {
    float Y[PRT_COUNT];
    prt_harmonics(from, Y);
    for (int k = 0; k < PRT_K; k++) b[k] += E * Y[k];
}

void prt_add_constant(inout float3 b[PRT_K], float3 radiance) { b[0] += radiance * 3.5449077; }  // √4π
