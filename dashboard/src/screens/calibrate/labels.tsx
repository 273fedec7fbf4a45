/** Readings and labels that look wrong: each is judged by a person, then the device is calibrated again. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { significant } from "../../ui/format";
import { keptSignal } from "../../ui/kept";
import { Failure, Table } from "../../ui/parts";
import { RunAction } from "../../ui/run_action";
import { comparedRows } from "./former_result";
import { changedPoints, judgePoints, type Judgement, judgementsOf, type LabelFinding, meaning } from "./label_judgement";

type Document = Schemas["CalibrationDocument"];

interface LabelsProps {
  calibration: Document;
  /** Shows another calibration. */
  open: (id: string) => void;
}

export function Labels({ calibration, open }: LabelsProps) {
  const findings = calibration.result.labels;
  const judgements = useSignal<readonly Judgement[]>([]);
  /** The points changed in the run that was posted, whatever is judged meanwhile; kept as long as the run is. */
  const posted = keptSignal(`points judged ${calibration.id}`);
  const again = useSignal<string | null>(null);
  if (!findings.length) return <p>{text.calibrate.labelsGood}</p>;
  // Others are made from no readings of control points, or from those of an earlier calibration.
  const can = calibration.provenance === "fitted";
  const judged = judgePoints(calibration.points, findings, judgements.value);
  const changed = changedPoints(calibration.points, judged);
  return (
    <>
      <h3>{text.calibrate.labels}</h3>
      {can ? <p>{text.labels.help}</p> : null}
      <Table
        caption={text.calibrate.labels}
        columns={[text.labels.meaning, text.calibrate.probability, text.labels.residual, text.column.residual, ...(can ? [text.labels.judgement] : [])]}
        rows={findings.map((finding, index) => ({ finding, index }))}
        identity={({ index }) => index}
        empty=""
        row={({ finding, index }) => [
          meaning(finding, calibration.points),
          significant(finding.probability, 3),
          numbers(finding.residual_px),
          numbers(finding.normalised_residual),
          ...(can
            ? [
                <Choice
                  finding={finding}
                  calibration={calibration}
                  chosen={judgements.value[index] ?? "keep"}
                  choose={(judgement) =>
                    (judgements.value = findings.map((_, other) => (other === index ? judgement : (judgements.value[other] ?? "keep"))))
                  }
                />,
              ]
            : []),
        ]}
      />
      {can ? (
        <RunAction
          label={text.labels.again}
          operation="POST /api/v1/runs/calibration"
          session={calibration.id}
          disabled={changed.size === 0}
          start={() => {
            posted.value = JSON.stringify([...changed]);
            return sent(api.POST("/api/v1/runs/calibration", { body: requestOf(calibration, judged, judgements.value) }));
          }}
          done={(id) => (again.value = id)}
        />
      ) : null}
      {again.value ? (
        <BesideFormer key={again.value} former={calibration} id={again.value} changed={new Set<number>(JSON.parse(posted.value ?? "[]"))} open={open} />
      ) : null}
    </>
  );
}

function numbers(values: readonly (number | null)[]): string {
  return values.map((value) => significant(value, 2)).join(", ");
}

interface ChoiceProps {
  finding: LabelFinding;
  calibration: Document;
  chosen: Judgement;
  choose: (judgement: Judgement) => void;
}

function Choice({ finding, calibration, chosen, choose }: ChoiceProps) {
  return (
    <select
      aria-label={text.labels.judgementOf(meaning(finding, calibration.points))}
      value={chosen}
      onChange={({ currentTarget }) => choose(currentTarget.value as Judgement)}
    >
      {judgementsOf(finding).map((one) => (
        <option key={one} value={one}>
          {one === "repair" ? text.labels.repair[finding.kind === "wrong-label" ? "wrong-label" : "exchanged"] : text.labels[one]}
        </option>
      ))}
    </select>
  );
}

/** Return the run that calibrates as the calibration was, from the judged points. */
function requestOf(calibration: Document, points: Document["points"], judgements: readonly Judgement[]): Schemas["NewCalibrationRun"] {
  const settings = calibration.result.settings;
  const changes = calibration.result.labels.flatMap((finding, index) => {
    const judgement = judgements[index] ?? "keep";
    return judgement === "keep" ? [] : [text.labels.changed(meaning(finding, calibration.points), judgement)];
  });
  return {
    device_id: calibration.device_id,
    points,
    distortion: settings?.distortion ?? "auto",
    position_sigma_mm: settings?.position_sigma_mm ?? null,
    loss: settings?.loss ?? "linear",
    // A person has judged: the server changes no label, and says what still looks wrong.
    labels: "report",
    allow_incomplete: false,
    note: text.labels.note(calibration.id, changes).slice(0, MAX_NOTE),
  };
}

const MAX_NOTE = 2000;

interface BesideProps {
  former: Document;
  id: string;
  changed: ReadonlySet<number>;
  open: (id: string) => void;
}

function BesideFormer({ former, id, changed, open }: BesideProps) {
  const path = { params: { path: { calibration_id: id } } };
  const polled = usePolled(`calibration ${id}`, () => sent(api.GET("/api/v1/calibrations/{calibration_id}", path)), 3600);
  const now = polled.value;
  return (
    <>
      <h3>{text.labels.beside}</h3>
      <Failure message={polled.error} />
      {now ? (
        <>
          <p>{text.labels.besideHelp}</p>
          <Table
            caption={text.labels.beside}
            columns={[text.labels.figure, text.labels.former(former.id), text.labels.now(id)]}
            rows={comparedRows(former, now, changed)}
            identity={({ figure }) => figure}
            empty={text.missing}
            row={({ figure, former: before, now: after }) => [figure, before, after]}
          />
          <button type="button" onClick={() => open(id)}>
            {text.labels.open(id)}
          </button>
        </>
      ) : (
        <p class="muted">{text.loading}</p>
      )}
    </>
  );
}
