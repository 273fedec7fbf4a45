/** What a plan says, beside the profile as it was. */

import { text } from "../../text";
import { significant } from "../../ui/format";
import { Badge, Panel, Table } from "../../ui/parts";
import { contributions, difference, type Figure, figures, type Plan } from "./plan_figures";

interface PlanResultProps {
  plan: Plan;
  /** Of the profile as it was; null: it cannot be planned. */
  base: Plan | null;
}

export function PlanResult({ plan, base }: PlanResultProps) {
  const before = base ? figures(base) : [];
  const rows = figures(plan).map((after) => ({ after, before: before.find(({ name }) => name === after.name) }));
  return (
    <>
      <Panel title={text.plan.reached}>
        <Table
          caption={text.plan.reached}
          columns={[text.plan.figure, text.plan.now, text.plan.before, text.plan.change]}
          rows={rows}
          identity={({ after }) => after.name}
          empty={text.missing}
          row={({ after, before: was }) => {
            if (!was) return [after.name, written(after), text.missing, text.missing];
            const { kind, words } = difference(was, after);
            return [after.name, written(after), written(was), <Badge kind={kind}>{words}</Badge>];
          }}
        />
      </Panel>
      <Panel title={text.plan.budget}>
        <Table
          caption={text.plan.budget}
          columns={[text.plan.source, text.column.kind, text.plan.rms, text.plan.share]}
          rows={contributions(plan)}
          identity={({ name }) => name}
          empty={text.plan.noBudget}
          row={({ name, kind, rms, share, assumed }) => [
            assumed ? text.plan.assumed(name) : name,
            kind,
            significant(rms, 2),
            <span class="row">
              <meter min={0} max={1} value={share} aria-label={name} />
              {`${significant(100 * share, 2)} %`}
            </span>,
          ]}
        />
      </Panel>
      <Panel title={text.column.sensors}>
        <Table
          caption={text.column.sensors}
          columns={[text.light.sensor, text.plan.bound, text.plan.centroid, text.plan.electrons, text.plan.saturated, text.plan.seen]}
          rows={plan.sensors.map((sensor, index) => ({ sensor, seen: plan.coverage.by_sensor[index] }))}
          identity={({ sensor }) => sensor.name}
          empty={text.missing}
          row={({ sensor, seen }) => [
            sensor.name,
            significant(sensor.bound_px, 2),
            significant(sensor.centroid_px, 2),
            significant(sensor.peak_electrons, 3),
            `${significant(100 * sensor.saturated, 2)} %`,
            seen === undefined ? text.missing : `${significant(100 * seen, 3)} %`,
          ]}
        />
        <Table
          caption={text.plan.ghostsTitle}
          columns={[text.plan.lit, text.plan.ghostCount, text.plan.combinations]}
          rows={plan.ghosts}
          identity={({ markers }) => markers}
          empty={text.plan.noGhosts}
          row={({ markers, expected, standard_error, candidates }) => [
            markers,
            `${significant(expected, 2)} ± ${significant(standard_error, 1)}`,
            significant(candidates, 3),
          ]}
        />
        <ul class="muted">
          {plan.notes.map((note) => (
            <li key={note}>{note}</li>
          ))}
        </ul>
      </Panel>
    </>
  );
}

function written({ value, unit, sigma }: Figure): string {
  return `${significant(value, 3)}${sigma ? ` ± ${significant(sigma, 1)}` : ""} ${unit}`;
}
