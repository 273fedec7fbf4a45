/** What still markers are compared with in a drift check. */

import type { Signal } from "@preact/signals";
import type { Schemas } from "../../api/client";
import { text } from "../../text";

export type Against = Schemas["NewDriftCheck"]["against"];

export function AgainstSelect({ against, choices }: { against: Signal<Against>; choices: readonly Against[] }) {
  return (
    <label>
      {text.quality.against}{" "}
      <select value={against.value} onChange={({ currentTarget }) => (against.value = currentTarget.value as Against)}>
        {choices.map((one) => (
          <option key={one} value={one}>
            {text.quality.againsts[one]}
          </option>
        ))}
      </select>
    </label>
  );
}
