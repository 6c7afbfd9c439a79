"""GLSL code of the preview. Radiance is linear until the last line, which encodes it as `formats.image.png` does."""

import numpy as np
from numpy.typing import NDArray

from prt_bake.preview.mirrored import ALBEDOS
from prt_bake.shading import tone_map


def _matrix(matrix: NDArray[np.floating]) -> str:
    return f"mat3({', '.join(f'{number:.9f}' for number in matrix.T.ravel())})"


def _polynomial(coefficients: NDArray[np.floating]) -> str:
    """Return the polynomial of `encoded` by Horner's rule; `coefficients` begin with that of the highest power."""
    code = f"vec3({coefficients[0]:.9f})"
    for coefficient in coefficients[1:]:
        code = f"({code}) * encoded + {coefficient:.9f}"
    return code


_ENCODE = """
vec3 encoded(vec3 linear) {
  vec3 value = clamp(linear * gain, 0.0, 1.0);
  return mix(12.92 * value, 1.055 * pow(max(value, vec3(1e-9)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, value));
}
"""
"""Uniform: gain, 2 to the power of the exposure."""

_AGX = f"""
vec3 agx(vec3 linear) {{
  vec3 inside = {_matrix(tone_map.INSET)} * max({_matrix(tone_map.TO_REC2020)} * linear, 0.0);
  vec3 stops = log2(max(inside, 1e-10));
  vec3 encoded = clamp((stops - {tone_map.LOWEST:.9f}) / {tone_map.HIGHEST - tone_map.LOWEST:.9f}, 0.0, 1.0);
  encoded = {_polynomial(tone_map.CURVE)};
  vec3 shown = pow(max({_matrix(tone_map.OUTSET)} * encoded, 1e-9), vec3({tone_map.DISPLAY_GAMMA:.9f}));
  return {_matrix(tone_map.FROM_REC2020)} * shown;
}}
"""
"""As `prt_bake.shading.tone_map`."""


def encode(mapping: tone_map.ToneMap) -> str:
    """Return the code of `encoded`. A tone map that is off is left out: Mesa would compute it nevertheless."""
    return _ENCODE if mapping == "none" else _AGX + _ENCODE.replace("linear * gain", "agx(linear * gain)")


LOOK_UP = """
vec3 fromSky(vec3 direction) {
  vec3 polar = toSky * direction;
  float u = atan(polar.y, polar.x) / 6.283185307179586 + 0.5;
  float v = atan(length(polar.xy), polar.z) / 3.141592653589793;
  return texture(actortexture, vec2(u, clamp(v, halfRow, 1.0 - halfRow))).rgb;
}
"""
"""As `prt_bake.lights.environment.lookup`. Uniforms: toSky, and halfRow, half of a row of the picture."""

FULL_SCREEN = "gl_Position = vec4(vertexMC.xy, 1.0, 1.0);\n"

SKY = """
vec2 place = 2.0 * tcoordVCVSOutput - 1.0;
gl_FragData[0] = vec4(encoded(fromSky(forward + place.x * across + place.y * above)), 1.0);
"""
"""Uniforms: forward, across and above; their sum is the direction through the window's upper right corner."""

PICTURE = """
vec2 inside = (2.0 * tcoordVCVSOutput - 1.0) / extent;
if (max(abs(inside.x), abs(inside.y)) > 1.0) discard;
gl_FragData[0] = vec4(encoded(texture(actortexture, 0.5 + 0.5 * inside * vec2(1.0, -1.0)).rgb), 1.0);
"""
"""Uniform: extent, width and height of the picture relative to the window."""

OBJECT_VERTEX_DECLARATIONS = """
in vec4 colourMC;
in vec3 shadingNormalMC;
out vec4 colour;
out vec3 shadingNormal;
out vec3 positionMC;
"""
OBJECT_VERTEX = "colour = colourMC;\nshadingNormal = shadingNormalMC;\npositionMC = vertexMC.xyz;\n"
OBJECT_DECLARATIONS = "in vec4 colour;\nin vec3 shadingNormal;\nin vec3 positionMC;\n"

REFLECTANCE = f"""
float reflectance(float cosine) {{
  float place = sqrt(cosine) * {ALBEDOS - 1}.0;
  int below = min(int(place), {ALBEDOS - 2});
  return mix(albedo[below], albedo[below + 1], place - float(below));
}}
"""
"""Uniform: albedo, as `prt_bake.preview.mirrored.directional_albedo`."""

OBJECT = "vec3 radiance = colour.a > 0.0 ? colour.rgb / colour.a : vec3(0.0);\n"
OBJECT_REFLECTION = """
vec3 outgoing = normalize(eyeMC - positionMC);
vec3 normal = normalize(shadingNormal);
radiance += reflectance(clamp(dot(outgoing, normal), 0.0, 1.0)) * fromSky(reflect(-outgoing, normal));
"""
"""Uniform: eyeMC, the position of the eye."""
OBJECT_OUTPUT = "gl_FragData[0] = vec4(encoded(radiance), 1.0);\n"
