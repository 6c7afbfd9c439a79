// The light of a scene as nine coefficients b of radiance in the object space of an asset. Not run in Unity.
using System;
using UnityEngine;
using UnityEngine.Rendering;

public static class PrtbakeLight
{
    // Object space is right-handed: its z is -z of the GameObject.
    public static Vector3 Mirrored(Vector3 v) { return new Vector3(v.x, v.y, -v.z); }

    // Harmonics up to degree 2: index l(l+1)+m, orthonormal, no Condon-Shortley phase.
    public static float[] Harmonics(Vector3 d)
    {
        return new[] {
            0.28209479f, 0.48860251f * d.y, 0.48860251f * d.z, 0.48860251f * d.x, 1.09254843f * d.x * d.y,
            1.09254843f * d.y * d.z, 0.31539157f * (3 * d.z * d.z - 1), 1.09254843f * d.x * d.z,
            0.54627422f * (d.x * d.x - d.y * d.y)
        };
    }

    // Ambient light, irradiance / pi as a sum of harmonics: exact through the twelve corners of an icosahedron.
    // toWorld turns directions of the GameObject into directions of the world, such as transform.TransformDirection.
    public static void AddAmbient(Vector3[] b, SphericalHarmonicsL2 probe, Func<Vector3, Vector3> toWorld)
    {
        var corners = new Vector3[12];
        var world = new Vector3[12];
        var colours = new Color[12];
        for (int i = 0; i < 12; i++) {
            float s = (i & 1) == 0 ? 0.52573111f : -0.52573111f, t = (i & 2) == 0 ? 0.85065081f : -0.85065081f;
            corners[i] = i < 4 ? new Vector3(0, s, t) : i < 8 ? new Vector3(s, t, 0) : new Vector3(t, 0, s);
            world[i] = toWorld(Mirrored(corners[i]));
        }
        probe.Evaluate(world, colours);
        for (int i = 0; i < 12; i++) {
            float[] Y = Harmonics(corners[i]);
            for (int k = 0; k < b.Length; k++) {
                float toRadiance = k == 0 ? 1f : k < 4 ? 1.5f : 4f; // pi / A_l
                var colour = new Vector3(colours[i].r, colours[i].g, colours[i].b);
                b[k] += colour * (Y[k] * toRadiance * 4f * Mathf.PI / 12f);
            }
        }
    }

    // A directional light of the built-in and the universal pipeline: intensity 1 is an irradiance of pi.
    public static void AddDirectional(Vector3[] b, Vector3 from, Color linear, float intensity)
    {
        float[] Y = Harmonics(Mirrored(from)); // from: unit vector to the light, as the GameObject sees it
        for (int k = 0; k < b.Length; k++)
            b[k] += new Vector3(linear.r, linear.g, linear.b) * (intensity * Mathf.PI * Y[k]);
    }
}
