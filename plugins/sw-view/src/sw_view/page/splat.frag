#version 300 es
// Blended from back to front, so that what rounding did to a covered layer is covered with it.
precision highp float;

flat in vec4 color;
in vec2 sigmas;
out vec4 drawn;

void main() {
  float alpha = min(0.99, color.a * exp(-0.5 * dot(sigmas, sigmas)));
  if (alpha < 1.0 / 255.0) discard;
  drawn = vec4(color.rgb * alpha, alpha);
}
