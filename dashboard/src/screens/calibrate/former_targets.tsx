/** Targets of an earlier capture session, to place markers there again. */

import { api, sent } from "../../api/client";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { targetsTable } from "../../ui/targets";

export function FormerTargets({ device, take }: { device: Device; take: (table: string) => void }) {
  const query = { device_id: device.id, limit: 20 };
  const captures = usePolled(`captures ${device.id}`, () => sent(api.GET("/api/v1/captures", { params: { query } })), 10);
  const items = captures.value?.items ?? [];
  if (!items.length) return null;
  return (
    <label>
      {text.way.former}{" "}
      <select
        value=""
        onChange={({ currentTarget }) => {
          const chosen = items.find(({ id }) => id === currentTarget.value);
          if (chosen) take(targetsTable(chosen.targets.map((target) => ({ ...target, marker: target.marker ?? null }))));
        }}
      >
        <option value="">{text.missing}</option>
        {items.map(({ id, targets }) => (
          <option key={id} value={id}>
            {text.way.formerOption(id, targets.length)}
          </option>
        ))}
      </select>
    </label>
  );
}
