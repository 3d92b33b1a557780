// Colours of MeshSplats in Unity (URP): vertex colours, or harmonics of degree 1 in texture coordinates as glTFast
// imports them, which mirrors x and stores v as 1 - v. Not run.
Shader "MeshSplats/Unlit"
{
    Properties
    {
        [Toggle] _ViewDependent ("Colours depend on the view", Float) = 0
        _Base ("Base (extras.meshsplats.viewColors)", Float) = 1
        _Scale ("Scale", Float) = 1
        [Enum(UnityEngine.Rendering.BlendMode)] _Source ("Source, of blended triangles SrcAlpha", Float) = 1
        [Enum(UnityEngine.Rendering.BlendMode)] _Target ("Target, of blended triangles OneMinusSrcAlpha", Float) = 0
        [Toggle] _Depth ("Writes depth, not of blended triangles", Float) = 1
    }
    SubShader
    {
        Tags { "RenderPipeline" = "UniversalPipeline" "RenderType" = "Opaque" "Queue" = "Geometry" }
        Cull Off
        Blend [_Source] [_Target]
        ZWrite [_Depth]
        Pass
        {
            HLSLPROGRAM
            #pragma vertex vert
            #pragma fragment frag
            #include "Packages/com.unity.render-pipelines.universal/ShaderLibrary/Core.hlsl"

            CBUFFER_START(UnityPerMaterial)
                float _ViewDependent, _Base, _Scale;
            CBUFFER_END

            struct Vertex { float3 position : POSITION; float4 color : COLOR; float2 uv0 : TEXCOORD0; float2 uv1 : TEXCOORD1; };
            struct Drawn { float4 position : SV_POSITION; float4 color : COLOR; };

            float3 Unpack(float t) { return float3(fmod(t, 256), fmod(floor(t / 256), 256), floor(t / 65536)); }
            float3 Sh(float t) { return (Unpack(t) - 128) * _Scale / 127; }
            float3 ToLinear(float3 c) { return c <= 0.04045 ? c / 12.92 : pow((c + 0.055) / 1.055, 2.4); }

            Drawn vert(Vertex v)
            {
                Drawn o;
                o.position = TransformObjectToHClip(v.position);
                o.color = v.color;
                if (_ViewDependent > 0.5)
                {
                    float3 d = normalize(v.position - TransformWorldToObject(_WorldSpaceCameraPos));
                    d.x = -d.x;
                    float3 shown = Unpack(v.uv0.x) * _Base / 255
                        + 0.488603 * (d.z * Sh(v.uv1.x) - d.y * Sh(1 - v.uv0.y) - d.x * Sh(1 - v.uv1.y));
                    o.color.rgb = max(0, shown);
                    #ifndef UNITY_COLORSPACE_GAMMA
                    o.color.rgb = ToLinear(o.color.rgb);
                    #endif
                }
                return o;
            }

            half4 frag(Drawn i) : SV_Target { return i.color; }
            ENDHLSL
        }
    }
}
