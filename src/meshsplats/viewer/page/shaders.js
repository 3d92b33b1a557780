// The shaders of WebGL2: of the mesh, the splats and the image that is shown.

const LENS = `
uniform vec4 row0, row1, row2, lens; // world to camera; fx fy cx cy
uniform vec3 size;                   // width, height, near
vec3 seen(vec3 p) { vec4 q = vec4(p, 1); return vec3(dot(row0, q), dot(row1, q), dot(row2, q)); }
vec4 clip(vec3 c) {
  return vec4(2. * lens.x / size.x * c.x + (2. * lens.z / size.x - 1.) * c.z,
    -2. * lens.y / size.y * c.y + (1. - 2. * lens.w / size.y) * c.z, c.z - 2. * size.z, c.z);
}
ivec2 place(uint i) { return ivec2(i & 4095u, i >> 12); }
`;
const HEAD = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
`;
// Display colours to linear light, and back (sRGB).
const CURVES = `
vec3 decode(vec3 c) { return mix(c / 12.92, pow((max(c, 0.) + .055) / 1.055, vec3(2.4)), step(.04045, c)); }
vec3 encode(vec3 c) {
  return mix(c * 12.92, 1.055 * pow(max(c, 0.), vec3(1. / 2.4)) - .055, step(.0031308, c));
}
`;
// terms: spherical harmonics of each splat, in the order of the core; 0 for none. textured: whether vertices
// have coordinates in a picture, which is multiplied with their colours in linear light, where these are
// interpolated, too.
const textures = textured => textured ? "#define TEXTURED\n" : "";
export const meshVertex = (terms, textured) => HEAD + textures(textured) + CURVES + LENS + `
#define TERMS ${terms}
in vec3 position; in vec4 color;
#ifdef TEXTURED
in vec2 coordinate;
centroid out vec2 uv;
#endif
uniform float brightest; // display value of the largest number in \`color\`
centroid out vec4 rgba;
#if TERMS > 0
precision highp isampler2D;
in uint owner; // the vertex's splat
uniform isampler2D harmonics; // a texel for each term of a splat
uniform vec3 eye;
uniform float harmonicStep;
vec3 term(int k) { return vec3(texelFetch(harmonics, place(owner * uint(TERMS) + uint(k)), 0).rgb); }
vec3 shade(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = .48860251 * (z * term(1) - y * term(0) - x * term(2));
#if TERMS > 3
  sum += 1.0925485 * (x * y * term(3) - y * z * term(4) - x * z * term(6) + .5 * (xx - yy) * term(7)) +
    .31539157 * (2. * zz - xx - yy) * term(5);
#endif
#if TERMS > 8
  sum += 2.8906114 * (x * y * z * term(9) + .5 * z * (xx - yy) * term(13)) -
    .59004360 * (y * (3. * xx - yy) * term(8) + x * (xx - 3. * yy) * term(14)) -
    .45704580 * (4. * zz - xx - yy) * (y * term(10) + x * term(12)) +
    .37317634 * z * (2. * zz - 3. * (xx + yy)) * term(11);
#endif
  return sum * harmonicStep;
}
#endif
void main() {
  rgba = vec4(color.rgb * brightest, color.a);
#if TERMS > 0
  rgba.rgb = max(rgba.rgb + shade(normalize(position - eye)), 0.);
#endif
#ifdef TEXTURED
  rgba.rgb = decode(rgba.rgb);
  uv = coordinate;
#endif
  gl_Position = clip(seen(position));
}`;
export const meshFragment = textured => HEAD + textures(textured) + CURVES + `
uniform float solid; // opacity of all fragments; negative: that of the vertices
centroid in vec4 rgba;
#ifdef TEXTURED
uniform sampler2D picture;
centroid in vec2 uv;
#endif
out vec4 result;
void main() {
  float alpha = solid < 0. ? rgba.a : solid;
  vec3 rgb = rgba.rgb;
#ifdef TEXTURED
  rgb = encode(rgb * decode(texture(picture, uv).rgb));
#endif
  result = vec4(rgb * alpha, alpha);
}`;
export const SPLAT_VERTEX = HEAD + LENS + `
uniform sampler2D means, shapes, colors;
uniform float dilation; uniform bool antialiased;
in uint item;
out vec4 rgba; out vec2 offset;
void main() {
  gl_Position = vec4(0, 0, 2, 1); // outside
  vec3 c = seen(texelFetch(means, place(item), 0).xyz);
  rgba = texelFetch(colors, place(item), 0);
  if (c.z < size.z || rgba.a < 1. / 255.) return;
  vec4 s = texelFetch(shapes, place(2u * item), 0), t = texelFetch(shapes, place(2u * item + 1u), 0);
  mat3 covariance = mat3(s.x, s.y, s.z, s.y, s.w, t.x, s.z, t.x, t.y);
  // EWA: the local affine approximation, where the direction is limited as in 3D Gaussian Splatting.
  vec2 limit = 1.3 * vec2(max(lens.z, size.x - lens.z), max(lens.w, size.y - lens.w)) / lens.xy;
  vec2 slope = clamp(c.xy / c.z, -limit, limit);
  vec3 jx = vec3(lens.x / c.z, 0, -lens.x * slope.x / c.z),
    jy = vec3(0, lens.y / c.z, -lens.y * slope.y / c.z);
  mat3 turn = mat3(row0.xyz, row1.xyz, row2.xyz);
  vec3 x = turn * jx, y = turn * jy;
  float a = dot(x, covariance * x), b = dot(x, covariance * y), d = dot(y, covariance * y);
  float before = max(a * d - b * b, 0.);
  a += dilation; d += dilation;
  float determinant = a * d - b * b;
  if (!(determinant > 0.)) return;
  if (antialiased) rgba.a *= sqrt(before / determinant);
  if (rgba.a < 1. / 255.) return;
  float middle = .5 * (a + d), spread = sqrt(max(middle * middle - determinant, 1e-9));
  float large = middle + spread, small = max(middle - spread, 1e-9);
  vec2 axis = abs(b) < 1e-9 ? (a >= d ? vec2(1, 0) : vec2(0, 1)) : normalize(vec2(b, large - a));
  offset = sqrt(2. * log(255. * rgba.a)) * vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID >> 1) * 2 - 1);
  vec2 pixel = lens.xy * c.xy / c.z + lens.zw + axis * sqrt(large) * offset.x +
    vec2(-axis.y, axis.x) * sqrt(small) * offset.y;
  gl_Position = vec4(2. * pixel.x / size.x - 1., 1. - 2. * pixel.y / size.y, 0, 1);
}`;
export const SPLAT_FRAGMENT = HEAD + `
in vec4 rgba; in vec2 offset;
out vec4 result;
void main() {
  float alpha = min(.99, rgba.a * exp(-.5 * dot(offset, offset)));
  if (alpha < 1. / 255.) discard;
  result = vec4(rgba.rgb * alpha, alpha);
}`;
export const PRESENT_VERTEX = HEAD + `
out vec2 uv;
void main() { uv = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.; gl_Position = vec4(2. * uv - 1., 0, 1); }`;
export const PRESENT_FRAGMENT = HEAD + CURVES + `
uniform sampler2D image; uniform vec3 background; uniform float gain; uniform bool linear;
in vec2 uv; out vec4 result;
void main() {
  vec4 c = texture(image, uv);
  vec3 rgb = c.rgb;
  if (gain != 1.) {
    vec3 own = rgb / max(c.a, 1e-6);
    rgb = c.a * (linear ? own * gain : encode(decode(own) * gain));
  }
  rgb += (1. - c.a) * (linear ? decode(background) : background);
  result = vec4(linear ? encode(rgb) : rgb, 1);
}`;
