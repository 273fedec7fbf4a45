/** Fills the table of targets with a regular grid. */

import { useSignal } from "@preact/signals";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { Failure } from "../../ui/parts";
import { targetsTable } from "../../ui/targets";
import { type EnteredGrid, gridTargets } from "./target_grid";

const FIELDS = ["origin", "steps", "counts"] as const;

export function GridForm({ take }: { take: (table: string) => void }) {
  const entered = useSignal<EnteredGrid>({ origin: "-200, -200, 1300", steps: "200, 200, 200", counts: "3, 3, 3" });
  const targets = attempt(() => gridTargets(entered.value));
  const wrong = typeof targets === "string";
  return (
    <details>
      <summary>{text.grid.title}</summary>
      <p>{text.grid.help}</p>
      <div class="row">
        {FIELDS.map((name) => (
          <label key={name}>
            {text.grid[name]}{" "}
            <input
              size={16}
              value={entered.value[name]}
              onInput={({ currentTarget }) => (entered.value = { ...entered.value, [name]: currentTarget.value })}
            />
          </label>
        ))}
        <button type="button" disabled={wrong} onClick={() => (wrong ? undefined : take(targetsTable(targets)))}>
          {wrong ? text.grid.noFill : text.grid.fill(targets.length)}
        </button>
      </div>
      <Failure message={wrong ? targets : null} />
    </details>
  );
}
