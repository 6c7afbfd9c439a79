// Prints what engines/unity makes of X.mesh.glb, and of an ambient light and a sun: one array of numbers a line.
using System;
using System.Globalization;
using System.IO;
using System.Linq;
using UnityEngine;
using UnityEngine.Rendering;

static class Program
{
    static void Main(string[] arguments)
    {
        Mesh mesh = PrtbakeMesh.Read(File.ReadAllBytes(arguments[0]), int.Parse(arguments[1]), int.Parse(arguments[2]));
        Print(mesh.vertices.SelectMany(Numbers));
        Print(mesh.normals.SelectMany(Numbers));
        Print(mesh.uv.SelectMany(one => new[] { one.x, one.y }));
        Print(mesh.uv2.SelectMany(one => new[] { one.x, one.y }));
        Print(mesh.triangles.Select(one => (float)one));
        float[] given = File.ReadAllText(arguments[3]).Split().Select(Number).ToArray();
        var probe = new SphericalHarmonicsL2();
        for (int i = 0; i < 27; i++) probe.values[i % 3, i / 3] = given[i];
        var b = new Vector3[9];
        // A GameObject that is turned by a third about the diagonal.
        PrtbakeLight.AddAmbient(b, probe, d => new Vector3(d.z, d.x, d.y));
        Print(b.SelectMany(Numbers));
        b = new Vector3[9];
        var colour = new Color { r = given[30], g = given[31], b = given[32] };
        PrtbakeLight.AddDirectional(b, new Vector3(given[27], given[28], given[29]), colour, given[33]);
        Print(b.SelectMany(Numbers));
    }

    static float[] Numbers(Vector3 v) { return new[] { v.x, v.y, v.z }; }
    static float Number(string text) { return float.Parse(text, CultureInfo.InvariantCulture); }

    static void Print(System.Collections.Generic.IEnumerable<float> numbers)
    {
        Console.WriteLine(string.Join(" ", numbers.Select(one => one.ToString("R", CultureInfo.InvariantCulture)).ToArray()));
    }
}
