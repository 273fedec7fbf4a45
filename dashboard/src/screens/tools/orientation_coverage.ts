/** How far a tool was turned: the RMS angles by which its directions swung. */

type Matrix = readonly (readonly number[])[];

/** Sums up orientations.
 *
 * With M their mean, a direction u of the tool, which points along R u, swung by an RMS angle whose
 * sine is sqrt(1 - |M u|^2): the singular values of M give those of the directions that swung
 * least and most, as the server's calibration takes them.
 */
export class OrientationCoverage {
  /** Number of orientations. */
  count = 0;
  private readonly sum = [0, 0, 0, 0, 0, 0, 0, 0, 0];

  /** Take an orientation, a rotation matrix by rows. */
  take(rotation: Matrix): void {
    this.count += 1;
    rotation.forEach((row, i) => row.forEach((value, j) => (this.sum[3 * i + j] = this.at(i, j) + value)));
  }

  /** Return the RMS angles of three perpendicular directions [deg], the smallest first; null: no orientation. */
  swings(): [number, number, number] | null {
    if (!this.count) return null;
    const columns = [0, 1, 2].map((j) => [0, 1, 2].map((i) => this.at(i, j) / this.count));
    const gram = columns.map((a) => columns.map((b) => a.reduce((sum, value, i) => sum + value * (b[i] ?? 0), 0)));
    return eigenvalues(gram).map((value) => (Math.asin(Math.sqrt(Math.min(1, Math.max(0, 1 - value)))) * 180) / Math.PI) as [number, number, number];
  }

  private at(i: number, j: number): number {
    return this.sum[3 * i + j] ?? 0;
  }
}

/** Return R_reference^T R_tool: the tool's orientation relative to its reference. */
export function relative(reference: Matrix, tool: Matrix): number[][] {
  return [0, 1, 2].map((i) => [0, 1, 2].map((j) => [0, 1, 2].reduce((sum, k) => sum + (reference[k]?.[i] ?? 0) * (tool[k]?.[j] ?? 0), 0)));
}

/** Return the eigenvalues of a symmetric 3 x 3 matrix, the largest first. */
function eigenvalues(matrix: Matrix): number[] {
  const m = (i: number, j: number) => matrix[i]?.[j] ?? 0;
  const mean = (m(0, 0) + m(1, 1) + m(2, 2)) / 3;
  const off = m(0, 1) ** 2 + m(0, 2) ** 2 + m(1, 2) ** 2;
  const size = Math.sqrt(([0, 1, 2].reduce((sum, i) => sum + (m(i, i) - mean) ** 2, 0) + 2 * off) / 6);
  if (size === 0) return [mean, mean, mean];
  const b = (i: number, j: number) => (m(i, j) - (i === j ? mean : 0)) / size;
  const determinant =
    b(0, 0) * (b(1, 1) * b(2, 2) - b(1, 2) ** 2) -
    b(0, 1) * (b(0, 1) * b(2, 2) - b(1, 2) * b(0, 2)) +
    b(0, 2) * (b(0, 1) * b(1, 2) - b(1, 1) * b(0, 2));
  const angle = Math.acos(Math.min(1, Math.max(-1, determinant / 2))) / 3;
  const [first, last] = [mean + 2 * size * Math.cos(angle), mean + 2 * size * Math.cos(angle + (2 * Math.PI) / 3)];
  return [first, 3 * mean - first - last, last];
}
