// The signatures of Unity that engines/unity uses, so that a C# compiler can check it, and as much of what they do as its
// arithmetic needs. The coefficients of a probe are summed as Unity's shaders sum them.
using System;

namespace UnityEngine
{
    public static class Mathf
    {
        public const float PI = 3.14159265f;
        public static float Floor(float x) { return (float)Math.Floor(x); }
    }
    public struct Vector2 { public float x, y; public Vector2(float x, float y) { this.x = x; this.y = y; } }
    public struct Vector3
    {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public static Vector3 operator +(Vector3 a, Vector3 b) { return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z); }
        public static Vector3 operator -(Vector3 a) { return a * -1f; }
        public static Vector3 operator *(Vector3 a, float s) { return new Vector3(a.x * s, a.y * s, a.z * s); }
    }
    public struct Vector4 { public Vector4(float x, float y, float z, float w) { } }
    public struct Color { public float r, g, b; public Color linear { get { return this; } } }
    public class Object { public string name; }
    public class Component : Object { public Transform transform; public T GetComponent<T>() { return default(T); } }
    public class MonoBehaviour : Component { }
    public class Transform
    {
        public Vector3 forward;
        public Vector3 TransformDirection(Vector3 d) { return d; }
        public Vector3 InverseTransformDirection(Vector3 d) { return d; }
    }
    public class Light : Component { public Color color; public float intensity; }
    public class Mesh : Object
    {
        public Rendering.IndexFormat indexFormat;
        public Vector3[] vertices, normals;
        public Vector2[] uv, uv2;
        public int[] triangles;
    }
    public class MeshFilter : Component { public Mesh sharedMesh; }
    public class MeshRenderer : Component { public void SetPropertyBlock(MaterialPropertyBlock block) { } }
    public class MaterialPropertyBlock
    {
        public void SetTexture(string name, Texture2D texture) { }
        public void SetVectorArray(string name, Vector4[] values) { }
    }
    public class TextAsset : Object { public string text; public byte[] bytes; }
    public class Texture2D : Object { public int width, height; }
    public enum FilterMode { Point }
    public enum TextureWrapMode { Clamp }
    public static class Debug { public static void LogError(string message, Object context) { } }
    public static class RenderSettings { public static Rendering.SphericalHarmonicsL2 ambientProbe; }
    public static class JsonUtility { public static T FromJson<T>(string text) { return (T)new Json(text).Read(typeof(T)); } }
    public class ExecuteAlways : Attribute { }
    public class RequireComponent : Attribute { public RequireComponent(Type a, Type b) { } }
}

namespace UnityEngine.Rendering
{
    public enum IndexFormat { UInt16, UInt32 }
    public class SphericalHarmonicsL2
    {
        public float[,] values = new float[3, 9];
        float Sum(Vector3 d, int channel)
        {
            float[] terms = { 1, d.y, d.z, d.x, d.x * d.y, d.y * d.z, 3 * d.z * d.z - 1, d.x * d.z, d.x * d.x - d.y * d.y };
            float sum = 0;
            for (int i = 0; i < 9; i++) sum += values[channel, i] * terms[i];
            return sum;
        }
        public void Evaluate(Vector3[] directions, Color[] results)
        {
            for (int i = 0; i < results.Length; i++)
                results[i] = new Color { r = Sum(directions[i], 0), g = Sum(directions[i], 1), b = Sum(directions[i], 2) };
        }
    }
}

namespace UnityEditor
{
    public class AssetImporter { }
    public class AssetPostprocessor { public string assetPath; public AssetImporter assetImporter; }
    public enum TextureImporterNPOTScale { None }
    public enum TextureImporterCompression { Uncompressed }
    public enum TextureImporterFormat { RGBAHalf }
    public class TextureImporterPlatformSettings { public int maxTextureSize; public TextureImporterFormat format; }
    public class TextureImporter : AssetImporter
    {
        public bool sRGBTexture, mipmapEnabled;
        public TextureImporterNPOTScale npotScale;
        public UnityEngine.FilterMode filterMode;
        public UnityEngine.TextureWrapMode wrapMode;
        public TextureImporterCompression textureCompression;
        public TextureImporterPlatformSettings GetDefaultPlatformTextureSettings() { return new TextureImporterPlatformSettings(); }
        public void SetPlatformTextureSettings(TextureImporterPlatformSettings settings) { }
    }
}
