/** Recordings: start, stop, list, download, delete, play. */

import { useSignal } from "@preact/signals";
import { api, fetchBlob, sent } from "../../api/client";
import { choose, device, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { newDeviceId } from "../../ui/device_id";
import { download } from "../../ui/download";
import { bytes, significant, time } from "../../ui/format";
import { useOpener } from "../../ui/opener";
import { Action, Badge, Failure, Panel, Table, Why } from "../../ui/parts";
import { startUnlessRunning } from "../../ui/start_device";
import type { Recording } from "./playback";
import { Player } from "./player";

export function Recordings() {
  const opened = useSignal<Recording | null>(null);
  /** Of the player, which stands above it. */
  const opener = useOpener();
  const open = (recording: Recording) => {
    opener.note();
    opened.value = recording;
  };
  const close = () => {
    opened.value = null;
    opener.giveFocusBack();
  };
  const recordings = usePolled("recordings", () =>
    sent(api.GET("/api/v1/recordings", { params: { query: { limit: 100 } } })),
  );
  const shown = device.value;
  const player = opened.value;
  return (
    <>
    {player ? <Player key={player.id} recording={player} close={close} /> : null}
    <Panel
      title={text.screens.recordings}
      actions={
        shown ? (
          <Action
            label={`${text.recordings.record}: ${shown.title || shown.id}`}
            kind="primary"
            operation="POST /api/v1/devices/{device_id}/recordings"
            run={() =>
              sent(
                api.POST("/api/v1/devices/{device_id}/recordings", {
                  params: { path: { device_id: shown.id } },
                  body: { contents: ["lines", "results"] },
                }),
              )
            }
            done={recordings.refresh}
          />
        ) : null
      }
    >
      <Failure message={recordings.error} />
      <Table
        caption={text.screens.recordings}
        columns={[text.column.name, text.column.device, text.column.state, text.column.frames, text.column.duration, text.column.size, text.column.started, text.column.action]}
        rows={recordings.value?.items ?? []}
        identity={(recording) => recording.id}
        empty={recordings.value ? text.recordings.none : text.loading}
        row={(recording) => [
          recording.id,
          recording.device_id ?? text.missing,
          <>
            <Badge kind={recording.state === "recording" ? "warn" : ["failed", "incomplete", "unreadable"].includes(recording.state) ? "bad" : "idle"}>
              {recording.state}
            </Badge>
            <Why reason={recording.reason} />
          </>,
          recording.frames_written ?? text.missing,
          significant(recording.duration_s, 3),
          bytes(recording.size_bytes),
          time(recording.started_at),
          <Actions recording={recording} refresh={recordings.refresh} open={() => open(recording)} />,
        ]}
      />
    </Panel>
    </>
  );
}

interface ActionsProps {
  recording: Recording;
  refresh: () => Promise<void>;
  open: () => void;
}

function Actions({ recording, refresh, open }: ActionsProps) {
  const path = { path: { recording_id: recording.id } };
  if (recording.state === "recording")
    return (
      <Action
        label={text.recordings.stop}
        kind="primary"
        operation="POST /api/v1/recordings/{recording_id}/stop"
        run={() => sent(api.POST("/api/v1/recordings/{recording_id}/stop", { params: path }))}
        done={refresh}
      />
    );
  return (
    <div class="row">
      <Action
        label={text.recordings.open}
        kind="primary"
        operation="GET /api/v1/recordings/{recording_id}/frames"
        disabled={recording.state === "unreadable"}
        run={async () => open()}
      />
      <Action
        label={text.recordings.play}
        operation={["POST /api/v1/devices", "POST /api/v1/devices/{device_id}/start"]}
        disabled={recording.state === "unreadable"}
        run={() => play(recording)}
      />
      <Action
        label={text.recordings.save}
        operation="GET /api/v1/recordings/{recording_id}/file"
        run={() => save(recording.id)}
      />
      <Action
        label={text.recordings.remove}
        kind="danger"
        operation="DELETE /api/v1/recordings/{recording_id}"
        confirm={text.confirm.remove(recording.id)}
        run={() => sent(api.DELETE("/api/v1/recordings/{recording_id}", { params: path }))}
        done={refresh}
      />
    </div>
  );
}

/** Play a recording as a device of its own, which the scene then shows. */
async function play(recording: Recording): Promise<void> {
  const known = await loadDevices();
  const before = known.find(({ source }) => source.kind === "replay" && source.recording_id === recording.id);
  const id = before?.id ?? newDeviceId(`replay-${recording.id.replace(/\.[^.]*$/, "")}`, new Set(known.map((one) => one.id)));
  if (!before)
    await sent(
      api.POST("/api/v1/devices", {
        body: { id, title: recording.id, source: { kind: "replay", recording_id: recording.id } },
      } as never),
    );
  await startUnlessRunning(id);
  await loadDevices();
  choose(id);
  location.hash = "#/scene";
}

async function save(name: string): Promise<void> {
  download(await fetchBlob(`/api/v1/recordings/${encodeURIComponent(name)}/file`), name);
}
