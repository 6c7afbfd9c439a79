// The mesh of X.mesh.glb, in the order of its vertices. uv2 is the first texel of each vertex. Not run in Unity.
using System;
using System.Text;
using UnityEngine;
using UnityEngine.Rendering;

public static class PrtbakeMesh
{
    [Serializable] class Document
    {
        public Node[] nodes; public Meshes[] meshes; public Accessor[] accessors; public View[] bufferViews;
    }
    [Serializable] class Node { public float[] scale; }
    [Serializable] class Meshes { public Primitive[] primitives; }
    [Serializable] class Primitive { public Attributes attributes; public int indices; }
    [Serializable] class Attributes { public int POSITION, NORMAL, TEXCOORD_0, TEXCOORD_1; }
    [Serializable] class Accessor { public int bufferView, componentType, count; }
    [Serializable] class View { public int byteOffset, byteLength; }

    const int Short = 5123; // componentType of indices of 16 bits; else 32

    public static Mesh Read(byte[] file, int width, int height)
    {
        int length = BitConverter.ToInt32(file, 12), binary = 28 + length;
        var document = JsonUtility.FromJson<Document>(Encoding.UTF8.GetString(file, 20, length));
        var primitive = document.meshes[0].primitives[0];
        Func<int, int> start = i => binary + document.bufferViews[document.accessors[i].bufferView].byteOffset;
        Func<int, int, float> number = (at, i) => BitConverter.ToSingle(file, at + 4 * i);
        Func<int, int, Vector3> vector = (at, v) => PrtbakeLight.Mirrored(
            new Vector3(number(at, 3 * v), number(at, 3 * v + 1), number(at, 3 * v + 2)));
        int positions = start(primitive.attributes.POSITION), normals = start(primitive.attributes.NORMAL);
        int uvs = start(primitive.attributes.TEXCOORD_0), texels = start(primitive.attributes.TEXCOORD_1);
        int count = document.accessors[primitive.attributes.POSITION].count;
        float[] scale = document.nodes[0].scale;
        float metres = scale != null && scale.Length == 3 ? scale[0] : 1f;
        Vector3[] position = new Vector3[count], normal = new Vector3[count];
        Vector2[] uv = new Vector2[count], texel = new Vector2[count];
        for (int v = 0; v < count; v++) {
            position[v] = vector(positions, v) * metres;
            normal[v] = vector(normals, v);
            uv[v] = new Vector2(number(uvs, 2 * v), 1 - number(uvs, 2 * v + 1));
            float column = Mathf.Floor(number(texels, 2 * v) * width);
            float row = Mathf.Floor(number(texels, 2 * v + 1) * height);
            texel[v] = new Vector2(column, height - 1 - row); // Unity stores the bottom row of a picture first
        }
        var indices = document.accessors[primitive.indices];
        int first = start(primitive.indices);
        var triangles = new int[indices.count];
        for (int i = 0; i < indices.count; i++) {
            bool half = indices.componentType == Short;
            int vertex = half ? BitConverter.ToUInt16(file, first + 2 * i) : BitConverter.ToInt32(file, first + 4 * i);
            triangles[i / 3 * 3 + 2 - i % 3] = vertex; // the mirror turns triangles around
        }
        return new Mesh {
            indexFormat = IndexFormat.UInt32, vertices = position, normals = normal, uv = uv, uv2 = texel,
            triangles = triangles
        };
    }
}
