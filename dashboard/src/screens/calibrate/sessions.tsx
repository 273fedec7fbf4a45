/** Capture sessions of a device that were begun: how far they are, and a button to go on. */

import type { Polled } from "../../live/polling";
import { text } from "../../text";
import { time } from "../../ui/format";
import { Failure, Panel, Table } from "../../ui/parts";

interface Session {
  id: string;
  created_at: string;
}

interface SessionsProps<T extends Session> {
  polled: Polled<{ items: T[] }>;
  /** Heading of how far a session is. */
  column: string;
  done: (session: T) => string;
  open: (id: string) => void;
}

export function Sessions<T extends Session>({ polled, column, done, open }: SessionsProps<T>) {
  return (
    <Panel title={text.calibrate.sessions}>
      <Failure message={polled.error} />
      <Table
        caption={text.calibrate.sessions}
        columns={[text.calibrate.session, column, text.column.created, text.column.action]}
        rows={polled.value?.items ?? []}
        identity={({ id }) => id}
        empty={polled.value ? text.calibrate.noSessions : text.loading}
        row={(one) => [
          one.id,
          done(one),
          time(one.created_at),
          <button type="button" onClick={() => open(one.id)}>
            {text.calibrate.resume}
          </button>,
        ]}
      />
    </Panel>
  );
}
