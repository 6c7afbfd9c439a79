// An asset of prtbake in the built-in and the universal pipeline; prtbake.hlsl lies beside it. Not run in Unity.
Shader "prtbake/Object"
{
    SubShader
    {
        Pass
        {
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex vert
            #pragma fragment frag
            #define PRT_VIEW_DEGREE 3 // "view_degree" of X.json
            #define PRT_LIGHT_DEGREE 2 // "light_degree"
            #include "UnityCG.cginc"
            #include "prtbake.hlsl"

            Texture2D<float4> _PrtCoefficients;
            float4 _PrtLight[PRT_K];

            struct Corner
            {
                float4 position : SV_Position;
                float3 radiance : TEXCOORD0;
            };

            Corner vert(float3 position : POSITION, float2 texel : TEXCOORD1)
            {
                float3 world = mul(unity_ObjectToWorld, float4(position, 1)).xyz;
                // Object space is right-handed: its z is -z of the mesh in Unity.
                float3x3 object_to_world = mul((float3x3)unity_ObjectToWorld, float3x3(1, 0, 0, 0, 1, 0, 0, 0, -1));
                float3 outgoing = prt_to_object(object_to_world, _WorldSpaceCameraPos - world);
                float3 b[PRT_K];
                for (int k = 0; k < PRT_K; k++) b[k] = _PrtLight[k].rgb;
                Corner corner;
                corner.radiance = prt_radiance(_PrtCoefficients, int2(texel), outgoing, b);
                corner.position = UnityObjectToClipPos(position);
                return corner;
            }

            float4 frag(Corner corner) : SV_Target
            {
                return float4(corner.radiance, 1);
            }
            ENDHLSL
        }
    }
}
