/** Stations on other machines, as rows of the Health page. */

import type { Schemas } from "../../api/client";

export type Station = Schemas["Station"];
export type Kind = "good" | "bad" | "idle";

/** Return the stations on other machines, those that need somebody first. */
export function remoteStations(all: readonly Station[]): readonly Station[] {
  const order = ["lost", "starting", "limited", "running"];
  return all
    .filter(({ name }) => name !== null)
    .sort((one, other) => order.indexOf(one.state) - order.indexOf(other.state) || (one.name ?? "").localeCompare(other.name ?? ""));
}

/** Return how urgent a station's state is. */
export function kindOf({ state }: Station): Kind {
  if (state === "running") return "good";
  return state === "lost" ? "bad" : "idle";
}
