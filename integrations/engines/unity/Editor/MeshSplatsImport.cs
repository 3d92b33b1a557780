// Gives the meshes of splats of the selected .glb files the shader MeshSplats/Unlit, and colliders of the names that
// MeshSplats writes their components. Not run.
using System;
using System.IO;
using System.Text;
using UnityEditor;
using UnityEngine;
using UnityEngine.Rendering;

public static class MeshSplatsImport
{
    private const string Folder = "Assets/MeshSplats/";

    [MenuItem("Assets/MeshSplats/Use shader")]
    private static void UseShader()
    {
        foreach (var chosen in Selection.gameObjects)
        {
            var colors = ViewColorsOf(AssetDatabase.GetAssetPath(chosen));
            Material solid = null, blended = null;
            var placed = (GameObject)PrefabUtility.InstantiatePrefab(chosen);
            foreach (var drawn in placed.GetComponentsInChildren<MeshRenderer>())
            {
                var only = drawn.name.EndsWith("-colonly");
                if (only || drawn.name.EndsWith("-col"))
                    drawn.gameObject.AddComponent<MeshCollider>();
                if (only)
                {
                    UnityEngine.Object.DestroyImmediate(drawn);
                    continue;
                }
                var materials = drawn.sharedMaterials;
                for (var i = 0; i < materials.Length; i++)
                {
                    if (materials[i] == null || !materials[i].name.StartsWith("splats"))
                        continue;
                    if (materials[i].renderQueue >= (int)RenderQueue.Transparent)
                        materials[i] = blended = blended ?? Made(chosen.name + " blended", colors, true);
                    else
                        materials[i] = solid = solid ?? Made(chosen.name, colors, false);
                }
                drawn.sharedMaterials = materials;
            }
        }
    }

    private static Material Made(string name, ViewColors colors, bool blends)
    {
        var material = new Material(Shader.Find("MeshSplats/Unlit"));
        if (colors.scale > 0)
        {
            material.SetFloat("_ViewDependent", 1);
            material.SetFloat("_Base", colors.@base);
            material.SetFloat("_Scale", colors.scale);
        }
        if (blends)
        {
            material.SetFloat("_Source", (float)BlendMode.SrcAlpha);
            material.SetFloat("_Target", (float)BlendMode.OneMinusSrcAlpha);
            material.SetFloat("_Depth", 0);
            material.renderQueue = (int)RenderQueue.Transparent;
        }
        AssetDatabase.CreateAsset(material, AssetDatabase.GenerateUniqueAssetPath(Folder + name + ".mat"));
        return material;
    }

    // extras.meshsplats.viewColors of a .glb with harmonics in texture coordinates; a scale of 0 without.
    private static ViewColors ViewColorsOf(string path)
    {
        var bytes = File.ReadAllBytes(path);
        var text = Encoding.UTF8.GetString(bytes, 20, BitConverter.ToInt32(bytes, 12));
        foreach (var mesh in JsonUtility.FromJson<Document>(text).meshes)
        {
            var found = mesh.extras?.meshsplats?.viewColors;
            if (found != null && found.scale > 0 && found.packing == "texcoords")
                return found;
        }
        return new ViewColors();
    }

    [Serializable] private class Document { public Listed[] meshes; }
    [Serializable] private class Listed { public Extras extras; }
    [Serializable] private class Extras { public Note meshsplats; }
    [Serializable] private class Note { public ViewColors viewColors; }
    [Serializable] private class ViewColors { public string packing; public float @base = 1, scale; }
}
