/** Ids of devices that the page makes: of a recording, of a profile. */

const MAX_LENGTH = 63;

/** Return an id for a device, made of a name and not taken: lower case letters, digits and hyphens. */
export function newDeviceId(name: string, taken: ReadonlySet<string>): string {
  const slug = name.toLowerCase().replaceAll(/[^a-z0-9]+/g, "-").replace(/^-/, "");
  for (let number = 1; ; number += 1) {
    const end = number === 1 ? "" : `-${number}`;
    const id = `${slug.slice(0, MAX_LENGTH - end.length).replace(/-$/, "") || "device"}${end}`;
    if (!taken.has(id)) return id;
  }
}
