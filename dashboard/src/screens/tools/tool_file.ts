/** Tools from a file: JSON as the server and `lumiline tools create` have it, or a table of markers. */

import type { Schemas } from "../../api/client";
import { text } from "../../text";
import { parseTargets } from "../../ui/targets";

export type NewTool = Schemas["NewTool"];

const OF_THE_SERVER = new Set(["tip", "origin", "created_at", "updated_at"]);
const TIP = "tip";

/** Return the tools of a file, or throw an Error that says what to change.
 *
 * JSON: a tool, a list of tools, or a page of them, as POST takes or GET sends it. A table has a
 * row for each marker (see `parseTargets`); with a column `marker` they are strobed, and a row named
 * `tip` is the tip.
 *
 * @param content of the file.
 * @param device whose tools they become.
 * @param id of the only tool; empty: the file's.
 */
export function parseTools(content: string, device: string, id: string): NewTool[] {
  const tools = /^\s*[[{]/.test(content) ? fromJson(content) : [fromTable(content)];
  if (id && tools.length !== 1) throw new Error(text.tools.severalTools(tools.length));
  return tools.map((tool) => {
    const named = { ...tool, device_id: device, ...(id ? { id } : {}) };
    if (!named.id) throw new Error(text.tools.noId);
    if (!Array.isArray(named.markers_mm)) throw new Error(text.tools.noMarkers(named.id));
    return { title: named.id, ...named } as NewTool;
  });
}

function fromJson(content: string): Partial<NewTool>[] {
  let read: unknown;
  try {
    read = JSON.parse(content);
  } catch (error) {
    throw new Error(text.tools.noJson((error as Error).message));
  }
  const listed = isObject(read) && Array.isArray(read.items) ? read.items : Array.isArray(read) ? read : [read];
  if (!listed.length || !listed.every(isObject)) throw new Error(text.tools.noTools);
  return listed.map((sent) => {
    const taken = Object.fromEntries(Object.entries(sent).filter(([name]) => !OF_THE_SERVER.has(name)));
    // The server checks what is in it.
    return (isObject(sent.tip) && sent.tip.position_mm ? { tip_mm: sent.tip.position_mm, ...taken } : taken) as Partial<NewTool>;
  });
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function fromTable(content: string): Partial<NewTool> {
  const rows = parseTargets(content, TIP);
  const markers = rows.filter(({ name }) => name !== TIP);
  const tip = rows.find(({ name }) => name === TIP);
  const strobed = markers.some(({ marker }) => marker !== null);
  return {
    markers_mm: markers.map(({ position_mm }) => position_mm),
    strobe_markers: strobed ? markers.map(({ marker }) => marker ?? 0) : null,
    ...(tip ? { tip_mm: tip.position_mm } : {}),
  };
}
