/** Gaussians of a .swz file. Row i of each array belongs to Gaussian i. */
export interface Gaussians {
  /** How many. */
  count: number;
  /** SH degree, 0 to 3; K = (degree + 1)^2. */
  degree: number;
  /** [count, 3], world units; axes as in COLMAP and 3DGS. */
  means: Float32Array;
  /** [count, 4], w, x, y, z, not always of unit length. */
  quats: Float32Array;
  /** [count, 3], standard deviations along the axes of the rotation, world units. A surfel's third one is 1e-8. */
  scales: Float32Array;
  /** [count], 0 to 1. */
  opacities: Float32Array;
  /** [count, K, 3], coefficients of red, green and blue: colour = 0.5 + sum of basis * coefficient. */
  sh: Float32Array;
  /** The header of the file. */
  meta: Header;
  /** SHA-256 of the decoded parameters (of wisp: of its integers), if it was asked for: what `sw decode --hash` prints. */
  hash: string | null;
}

/** The header, as docs/bitstream.md of Splatwizard has it. */
export interface Header {
  method: string;
  method_version: number;
  requires?: Record<string, string[]>;
  /** What the scene asks of a rasterizer, such as `antialias`. */
  raster: Record<string, unknown>;
  static: Record<string, unknown>;
  /** Name, offset, length and CRC-32 of each section. */
  sections: [string, number, number, number][];
  /** Of a file that may end early: sections, their bytes, and PSNR or null, up to each cut. */
  cuts?: [number, number, number | null][];
}

export interface Options {
  /** Ends the decoding early. */
  signal?: AbortSignal;
  /** Of a file with cuts, how many of its packets to decode; 0, the default: all. */
  packets?: number;
  /** Called with coarser Gaussians of a file with cuts, before it is whole: while a Response arrives, else for its first cut. */
  onCut?: (coarse: Gaussians) => void;
  /** Where Gaussians depend on the eye, the place [x, y, z] that its Gaussians are seen from; the default is the origin. */
  eye?: [number, number, number];
  /** Whether to compute the hash of the decoded parameters. */
  hash?: boolean;
  /** Whether to decode in a thread of its own; the default where the platform has `Worker`. */
  worker?: boolean;
}

/** What is wrong with a file; the message is that of the Python reader. */
export class DecodeError extends Error {
  /** The section that is to blame, or null: the file or its header. */
  section: string | null;
}

/** Decodes a file. Rejects with DecodeError for one that is damaged, or that needs more than this decoder knows. */
export function decode(source: Uint8Array | ArrayBuffer | Response | Blob, options?: Options): Promise<Gaussians>;

/**
 * A file whose Gaussians depend on the place to look from: anchors of `hac`, `hac-plus` and `cat-3dgs` spawn others, in
 * `compact3dgs` a field has their colours.
 */
export interface Live {
  /** The header of the file. */
  meta: Header;
  /** SHA-256 of the decoded parameters, if it was asked for. */
  hash: string | null;
  /** The Gaussians that are seen from a place [x, y, z], world units. */
  from(eye: [number, number, number]): Promise<Gaussians>;
  /** Ends the worker, and with it what it holds. */
  close(): void;
}

/** Decodes such a file, and stays to be asked what is seen from where. Rejects as `decode` does. */
export function live(
  source: Uint8Array | ArrayBuffer | Response | Blob, options?: Pick<Options, 'signal' | 'hash' | 'worker'>,
): Promise<Live>;

/** The header of a file, unchecked but for its form. */
export function info(bytes: Uint8Array): Header;
