/** The half sphere of the wand's directions as sectors of a disc, seen along z. */

export interface Sector {
  /** Path of SVG in a square from -1 to 1. */
  readonly path: string;
  readonly count: number;
}

/** Return the sectors of a cap and rings of equal solid angle, in the order of the bins.
 *
 * The disc keeps areas (Lambert's projection), so that all sectors are equally large. x is to the
 * right, y up.
 */
export function sectors(rings: readonly number[], bins: readonly number[]): Sector[] {
  const all = rings.reduce((sum, count) => sum + count, 0);
  const found: Sector[] = [];
  let before = 0;
  for (const count of rings) {
    const inner = Math.sqrt(before / all);
    const outer = Math.sqrt((before + count) / all);
    for (let number = 0; number < count; number += 1) {
      found.push({ path: sector(inner, outer, number / count, (number + 1) / count), count: bins[before + number] ?? 0 });
    }
    before += count;
  }
  return found;
}

function sector(inner: number, outer: number, from: number, to: number): string {
  if (to - from === 1) return `M ${outer} 0 A ${outer} ${outer} 0 0 0 ${-outer} 0 A ${outer} ${outer} 0 0 0 ${outer} 0 Z`;
  const [a, b, c, d] = [at(outer, from), at(outer, to), at(inner, to), at(inner, from)];
  return `M ${a} A ${outer} ${outer} 0 0 0 ${b} L ${c} A ${inner} ${inner} 0 0 1 ${d} Z`;
}

/** Return a point of the disc; y of SVG grows downwards. */
function at(radius: number, turn: number): string {
  const angle = 2 * Math.PI * turn;
  return `${(radius * Math.cos(angle)).toFixed(4)} ${(-radius * Math.sin(angle)).toFixed(4)}`;
}
