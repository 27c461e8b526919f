// The WebGL2 part: textures with the Gaussians, a frame of half floats to blend in, and its copy to the canvas.
const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1); }`;
const COPY_FRAGMENT = `#version 300 es
precision highp float; uniform sampler2D frame; uniform vec2 size; out vec4 drawn;
void main() { drawn = vec4(texture(frame, gl_FragCoord.xy / size).rgb, 1); }`;

class Renderer {
  constructor(canvas, gaussians, facts, sources, keep) {
    const gl = canvas.getContext('webgl2', { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: keep });
    if (!gl) throw new Error('This browser offers no WebGL2, which drawing Gaussians needs.');
    this.gl = gl, this.canvas = canvas, this.facts = facts, this.count = 0;
    this.blendsHalf = Boolean(gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float'));
    this.splats = this.program(sources.vertex, sources.fragment);
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.textures = [];
    this.rows = gl.createBuffer();
    this.quads = gl.createVertexArray();
    this.nothing = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.rows);
    const row = gl.getAttribLocation(this.splats.program, 'row');
    gl.enableVertexAttribArray(row);
    gl.vertexAttribIPointer(row, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(row, 1);
    this.put(gaussians);
    this.size = [0, 0];
  }

  put(gaussians) {
    this.texture(0, gaussians.words);
    this.texture(1, gaussians.harmonics);
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

  texture(unit, words) {
    const gl = this.gl, texels = Math.max(1, Math.ceil(words.length / 4));
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), width = Math.min(most, 2048), height = Math.ceil(texels / width);
    if (height > most) throw new Error('The GPU of this browser has no texture that is large enough for this scene.');
    const padded = new Uint32Array(4 * width * height);
    padded.set(words);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(this.textures[unit] ?? null);
    gl.bindTexture(gl.TEXTURE_2D, this.textures[unit] = gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, width, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
  }

  constants({ texels }) {
    const { gl, facts, splats: { program, at } } = this;
    gl.useProgram(program);
    gl.uniform1i(at.gaussians, 0);
    gl.uniform1i(at.harmonics, 1);
    gl.uniform1i(at.degree, facts.degree);
    gl.uniform1i(at.harmonicTexels, texels);
    gl.uniform1f(at.lowPass, facts.eps2d);
    gl.uniform1i(at.antialias, facts.antialias);
    gl.uniform2fv(at.scaleRange, facts.scales);
    gl.uniform2fv(at.colorRange, facts.colors);
    gl.uniform3fv(at.bandSteps, [...facts.bands, 0, 0, 0].slice(0, 3));
  }

  take(sorted) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.rows);
    gl.bufferData(gl.ARRAY_BUFFER, sorted, gl.DYNAMIC_DRAW);
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
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
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
