// The WebGL2 part: textures with the Gaussians, a frame of half floats to blend in, and its copy to the canvas.
const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1); }`;
const COPY_FRAGMENT = `#version 300 es
precision highp float; uniform sampler2D frame; uniform vec2 size; out vec4 drawn;
void main() { drawn = vec4(texture(frame, gl_FragCoord.xy / size).rgb, 1); }`;

const QUADS = 1024;  // Gaussians of an instance: one each costs a software renderer more than the drawing itself

class Renderer {
  constructor(canvas, gaussians, facts, sources, keep) {
    const gl = canvas.getContext('webgl2', { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: keep });
    if (!gl) throw new Error('This browser offers no WebGL2, which drawing Gaussians needs.');
    this.gl = gl, this.canvas = canvas, this.facts = facts, this.count = 0;
    this.blendsHalf = Boolean(gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float'));
    this.splats = this.program(sources.vertex, sources.fragment);
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.textures = [];
    this.quads = gl.createVertexArray();
    this.nothing = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const corners = Uint16Array.from({ length: 6 * QUADS }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.put(gaussians);
    this.size = [0, 0];
  }

  put(gaussians) {
    this.texture(0, gaussians.words, 4);
    this.texture(1, gaussians.harmonics, 4);
    this.constants(gaussians);
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map(shader => gl.getShaderInfoLog(shader));
      throw new Error(`The shaders cannot be compiled here: ${[gl.getProgramInfoLog(program), ...logs].join(' ')}`);
    }
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  texture(unit, words, channels) {  // four channels or one
    const gl = this.gl, texels = Math.max(1, Math.ceil(words.length / channels));
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), width = 2048, height = Math.ceil(texels / width);  // as splat.vert says
    if (height > most) throw new Error('The GPU of this browser has no texture that is large enough for this scene.');
    const padded = new Uint32Array(channels * width * height);
    padded.set(words);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(this.textures[unit] ?? null);
    gl.bindTexture(gl.TEXTURE_2D, this.textures[unit] = gl.createTexture());
    const [kind, format] = channels === 1 ? [gl.R32UI, gl.RED_INTEGER] : [gl.RGBA32UI, gl.RGBA_INTEGER];
    gl.texImage2D(gl.TEXTURE_2D, 0, kind, width, height, 0, format, gl.UNSIGNED_INT, padded);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
  }

  constants({ texels }) {
    const { gl, facts, splats: { program, at } } = this;
    gl.useProgram(program);
    gl.uniform1i(at.gaussians, 0);
    gl.uniform1i(at.harmonics, 1);
    gl.uniform1i(at.order, 3);
    gl.uniform1i(at.degree, facts.degree);
    gl.uniform1i(at.harmonicTexels, texels);
    gl.uniform1f(at.lowPass, facts.eps2d);
    gl.uniform1i(at.antialias, facts.antialias);
    gl.uniform2fv(at.scaleRange, facts.scales);
    gl.uniform2fv(at.colorRange, facts.colors);
    gl.uniform3fv(at.bandSteps, [...facts.bands, 0, 0, 0].slice(0, 3));
  }

  take(sorted) {
    this.texture(3, sorted, 1);
    this.count = sorted.length;
  }

  resize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return;
    const gl = this.gl;
    this.canvas.width = width, this.canvas.height = height, this.size = [width, height];
    if (!this.blendsHalf) return;
    gl.deleteTexture(this.frame);
    gl.deleteFramebuffer(this.target);
    this.frame = gl.createTexture(), this.target = gl.createFramebuffer();
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.frame);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.frame, 0);
  }

  // lens: {fx, fy, cx, cy} in pixels of the canvas; pose: {R, tau, eye}
  draw(pose, lens, width, height) {
    this.resize(width, height);
    const { gl, splats: { program, at } } = this;
    const half = [width / (2 * lens.fx), height / (2 * lens.fy)];
    const range = (principal, size, focal, margin) => [
      -(principal / focal + 0.3 * margin), (size - principal) / focal + 0.3 * margin];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.blendsHalf ? this.target : null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.facts.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    gl.uniformMatrix3fv(at.rotation, true, pose.R);
    gl.uniform3fv(at.translation, pose.tau);
    gl.uniform3fv(at.eye, pose.eye);
    gl.uniform2f(at.focal, lens.fx, lens.fy);
    gl.uniform2f(at.principal, lens.cx, lens.cy);
    gl.uniform2f(at.viewport, width, height);
    gl.uniform4f(at.slopes, ...range(lens.cx, width, lens.fx, half[0]), ...range(lens.cy, height, lens.fy, half[1]));
    gl.uniform1f(at.nearest, this.facts.near);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.quads);
    gl.uniform1i(at.count, this.count);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * QUADS, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / QUADS));
    if (!this.blendsHalf) return;
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.copy.program);
    gl.uniform1i(this.copy.at.frame, 2);
    gl.uniform2f(this.copy.at.size, width, height);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
