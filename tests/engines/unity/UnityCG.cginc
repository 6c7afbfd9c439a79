// What Prtbake.shader uses of Unity's include.
float4x4 unity_ObjectToWorld, unity_MatrixVP;
float3 _WorldSpaceCameraPos;
float4 UnityObjectToClipPos(float3 position) { return mul(unity_MatrixVP, mul(unity_ObjectToWorld, float4(position, 1))); }
