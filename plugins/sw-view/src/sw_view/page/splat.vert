#version 300 es
// One Gaussian as a quad: EWA projection (clamped slopes, low-pass) and spherical harmonics, as the rasterizers do.
// Every vertex projects its Gaussian anew: four times the work of the vertex stage, and no buffer in between.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D gaussians;   // two texels a Gaussian: mean (3 floats), scales; rotation, colour, opacity
uniform usampler2D harmonics;   // bytes of the bands above 0, four a word
uniform usampler2D order;       // rows of Gaussians, the farthest first
uniform int count, degree, harmonicTexels;
uniform mat3 rotation;          // world -> camera
uniform vec3 translation, eye;
uniform vec2 focal, principal, viewport;  // pixels of the frame
uniform vec4 slopes;            // least and largest x/z, y/z of the Jacobian
uniform float nearest, lowPass;
uniform bool antialias;
uniform vec2 scaleRange, colorRange;      // least value, step
uniform vec3 bandSteps;

flat out vec4 color;
out vec2 sigmas;                // place in the ellipse, in standard deviations along its axes

const float LIMIT = 1.0 / 255.0;

const int CORNERS = 4096;       // of an instance, four a Gaussian
int row;

uvec4 texel(usampler2D source, int index) {  // textures are 2,048 texels wide
  return texelFetch(source, ivec2(index & 2047, index >> 11), 0);
}

uvec4 words[3];                 // of the bands above 0

float byteOf(int index) {       // one coefficient, -128..127
  return float(int((words[index / 16][(index / 4) % 4] >> uint(8 * (index % 4))) & 255u) - 128);
}

vec3 coefficient(int k) {       // k = 1 .. 15
  int at = 3 * (k - 1);
  return vec3(byteOf(at), byteOf(at + 1), byteOf(at + 2));
}

vec3 colorFrom(vec3 d) {        // d: unit vector from the eye; the basis and its signs are those of 3DGS
  float x = d.x, y = d.y, z = d.z;
  for (int i = 0; i < harmonicTexels; i++) words[i] = texel(harmonics, row * harmonicTexels + i);
  vec3 sum = 0.4886025119029199 * bandSteps.x *
      (-y * coefficient(1) + z * coefficient(2) - x * coefficient(3));
  if (degree < 2) return sum;
  float xx = x * x, yy = y * y, zz = z * z;
  sum += bandSteps.y * (
      1.0925484305920792 * (x * y * coefficient(4) - y * z * coefficient(5) - x * z * coefficient(7)) +
      0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(6) +
      0.5462742152960396 * (xx - yy) * coefficient(8));
  if (degree < 3) return sum;
  return sum + bandSteps.z * (
      -0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(9) + x * (xx - 3.0 * yy) * coefficient(15)) +
      2.890611442640554 * x * y * z * coefficient(10) +
      -0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(11) + x * coefficient(13)) +
      0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12) +
      1.445305721320277 * z * (xx - yy) * coefficient(14));
}

mat3 axesOf(uint word) {        // the largest of w, x, y, z is left out: its index, then three times ten bits
  vec3 three = (vec3(uvec3(word >> 20u, word >> 10u, word) & 1023u) - 511.0) * (0.7071067811865476 / 511.0);
  float rest = sqrt(max(0.0, 1.0 - dot(three, three)));
  uint largest = word >> 30u;
  vec4 q = largest == 0u ? vec4(rest, three)
      : largest == 1u ? vec4(three.x, rest, three.yz)
      : largest == 2u ? vec4(three.xy, rest, three.z) : vec4(three, rest);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
      2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
      2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside: nothing is drawn
  int place = (CORNERS * gl_InstanceID + gl_VertexID) / 4;
  if (place >= count) return;
  row = int(texel(order, place).x);
  uvec4 first = texel(gaussians, 2 * row), second = texel(gaussians, 2 * row + 1);
  vec3 mean = uintBitsToFloat(first.xyz);
  vec3 t = rotation * mean + translation;
  if (t.z <= nearest) return;

  vec3 scales = exp(scaleRange.x + scaleRange.y * vec3(uvec3(first.w, first.w >> 10u, first.w >> 20u) & 1023u));
  vec2 slope = clamp(t.xy / t.z, slopes.xz, slopes.yw);
  mat3 toWorld = axesOf(second.x), W = transpose(rotation);  // columns of W: the camera's axes
  vec3 right = focal.x / t.z * (W[0] - slope.x * W[2]), down = focal.y / t.z * (W[1] - slope.y * W[2]);
  vec3 p = scales * (right * toWorld), q = scales * (down * toWorld);
  float a = dot(p, p), b = dot(p, q), c = dot(q, q);
  vec3 n = cross(p, q);
  float flatArea = dot(n, n), area = flatArea + lowPass * (a + c) + lowPass * lowPass;
  if (!(area > 0.0)) return;
  float opacity = float(second.z) / 255.0;
  if (antialias) opacity *= sqrt(max(2.5e-5, flatArea / area));
  if (opacity < LIMIT) return;
  a += lowPass, c += lowPass;

  float middle = 0.5 * (a + c), gap = length(vec2(0.5 * (a - c), b));
  float larger = middle + gap, smaller = area / larger;
  vec2 axis = gap < 1e-9 * middle ? vec2(1, 0)
      : a > c ? normalize(vec2(larger - c, b)) : normalize(vec2(b, larger - a));
  sigmas = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0;
  sigmas *= sqrt(2.0 * log(255.0 * opacity));  // where alpha falls to 1/255
  vec2 centre = focal * t.xy / t.z + principal;
  centre += sigmas.x * sqrt(larger) * axis + sigmas.y * sqrt(smaller) * vec2(-axis.y, axis.x);

  vec3 rgb = colorRange.x + colorRange.y * vec3(uvec3(second.y, second.y >> 11u, second.y >> 22u)
      & uvec3(2047u, 2047u, 1023u)) * vec3(1.0, 1.0, 2047.0 / 1023.0);
  if (degree > 0) rgb += colorFrom(normalize(mean - eye));
  color = vec4(max(rgb, 0.0), opacity);
  gl_Position = vec4(2.0 * centre.x / viewport.x - 1.0, 1.0 - 2.0 * centre.y / viewport.y, 0.0, 1.0);
}
