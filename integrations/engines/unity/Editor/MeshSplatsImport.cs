// Gives the meshes of the selected objects the shader MeshSplats/Unlit. Not run.
using UnityEditor;
using UnityEngine;

public static class MeshSplatsImport
{
    [MenuItem("Assets/MeshSplats/Use shader")]
    private static void UseShader()
    {
        var material = new Material(Shader.Find("MeshSplats/Unlit"));
        AssetDatabase.CreateAsset(material, AssetDatabase.GenerateUniqueAssetPath("Assets/MeshSplats/MeshSplats.mat"));
        foreach (var chosen in Selection.gameObjects)
        {
            var placed = (GameObject)PrefabUtility.InstantiatePrefab(chosen);
            foreach (var drawn in placed.GetComponentsInChildren<MeshRenderer>())
            {
                if (drawn.name.EndsWith("-colonly"))
                {
                    drawn.gameObject.AddComponent<MeshCollider>();
                    Object.DestroyImmediate(drawn);
                    continue;
                }
                drawn.sharedMaterial = material;
            }
        }
    }
}
