// Shows an asset of prtbake: X.mesh.glb renamed to X.mesh.bytes, X.json, X.exr, and a material of Prtbake.shader with
// the degrees of X.json. Not run in Unity.
using System;
using UnityEngine;

[ExecuteAlways]
[RequireComponent(typeof(MeshFilter), typeof(MeshRenderer))]
public class PrtbakeObject : MonoBehaviour
{
    public TextAsset mesh, description;
    public Texture2D coefficients;
    public Light[] suns = new Light[0];

    [Serializable] class Description { public int light_degree; public Size texture; }
    [Serializable] class Size { public int width, height; }

    MaterialPropertyBlock block;
    int harmonics; // K

    void OnEnable()
    {
        var described = JsonUtility.FromJson<Description>(description.text);
        Size size = described.texture;
        if (coefficients.width != size.width || coefficients.height != size.height)
            Debug.LogError(coefficients.name + ": expected " + size.width + " x " + size.height + " texels, found "
                + coefficients.width + " x " + coefficients.height + "; import up to 16384, no powers of two", this);
        harmonics = (described.light_degree + 1) * (described.light_degree + 1);
        GetComponent<MeshFilter>().sharedMesh = PrtbakeMesh.Read(mesh.bytes, size.width, size.height);
        block = new MaterialPropertyBlock();
    }

    void LateUpdate()
    {
        var b = new Vector3[harmonics];
        if (harmonics == 1) b[0] = new Vector3(1, 1, 1); // the asset has its light in it
        else {
            PrtbakeLight.AddAmbient(b, RenderSettings.ambientProbe, transform.TransformDirection);
            foreach (Light sun in suns) {
                Vector3 from = transform.InverseTransformDirection(-sun.transform.forward);
                PrtbakeLight.AddDirectional(b, from, sun.color.linear, sun.intensity);
            }
        }
        block.SetTexture("_PrtCoefficients", coefficients);
        block.SetVectorArray("_PrtLight", Array.ConvertAll(b, one => new Vector4(one.x, one.y, one.z, 0)));
        GetComponent<MeshRenderer>().SetPropertyBlock(block);
    }
}
