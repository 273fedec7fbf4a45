/** The page's colours for canvases, which know no `light-dark()`. */

export type Colour = "text" | "muted" | "accent" | "good" | "warn" | "bad" | "line" | "panel";

const scheme = matchMedia("(prefers-color-scheme: dark)");
const resolved = new Map<Colour, string>();
scheme.addEventListener("change", () => resolved.clear());

/** Return a colour as it is in the scheme now. */
export function colour(name: Colour): string {
  const known = resolved.get(name);
  if (known) return known;
  const probe = document.createElement("span");
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  resolved.set(name, found);
  return found;
}

/** Call when light becomes dark or the other way; returns what ends that. */
export function onSchemeChange(call: () => void): () => void {
  scheme.addEventListener("change", call);
  return () => scheme.removeEventListener("change", call);
}
