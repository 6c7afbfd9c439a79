// Imports X.exr as numbers if X.json of prtbake lies beside it. Not run in Unity.
using System.IO;
using UnityEditor;
using UnityEngine;

public class PrtbakeTextures : AssetPostprocessor
{
    void OnPreprocessTexture()
    {
        string description = Path.ChangeExtension(assetPath, ".json");
        if (!assetPath.EndsWith(".exr") || !File.Exists(description)) return;
        if (!File.ReadAllText(description).Contains("\"generator\": \"prtbake")) return;
        var importer = (TextureImporter)assetImporter;
        importer.sRGBTexture = false;
        importer.mipmapEnabled = false;
        importer.npotScale = TextureImporterNPOTScale.None;
        importer.filterMode = FilterMode.Point;
        importer.wrapMode = TextureWrapMode.Clamp;
        importer.textureCompression = TextureImporterCompression.Uncompressed;
        TextureImporterPlatformSettings settings = importer.GetDefaultPlatformTextureSettings();
        settings.maxTextureSize = 16384;
        settings.format = TextureImporterFormat.RGBAHalf;
        importer.SetPlatformTextureSettings(settings);
    }
}
