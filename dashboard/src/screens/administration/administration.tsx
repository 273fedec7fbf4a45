/** Administration: who this page acts as, keys, the audit log, settings and backups. */

import type { ComponentChildren } from "preact";
import { key } from "../../api/key";
import { allowed, logOut, type Operation, scopeOf, session } from "../../api/session";
import { text } from "../../text";
import { Panel } from "../../ui/parts";
import { Audit } from "./audit";
import { Backups, SettingsInForce } from "./installation";
import { Keys } from "./keys";

export function Administration() {
  const now = session.value;
  return (
    <>
      <Panel
        title={text.administration.you}
        actions={
          key.value ? (
            <button type="button" onClick={() => void logOut()}>
              {text.access.logOut}
            </button>
          ) : null
        }
      >
        <p>
          <strong>{now?.kind === "local" ? text.access.local : text.access.key}</strong>
        </p>
        <p class="muted">{now?.scopes.join(", ")}</p>
      </Panel>
      <Allowed operation="GET /api/v1/keys" title={text.administration.keys}>
        <Keys />
      </Allowed>
      <Allowed operation="GET /api/v1/audit" title={text.administration.audit}>
        <Audit />
      </Allowed>
      <Allowed operation="GET /api/v1/backups" title={text.administration.backups}>
        <Backups />
      </Allowed>
      <Allowed operation="GET /api/v1/settings" title={text.administration.settings}>
        <SettingsInForce />
      </Allowed>
    </>
  );
}

/** What an operation shows, or that it is not allowed. */
function Allowed({ operation, title, children }: { operation: Operation; title: string; children: ComponentChildren }) {
  if (allowed(operation)) return <>{children}</>;
  return (
    <Panel title={title}>
      <p class="muted">{text.access.notAllowed(scopeOf(operation))}</p>
    </Panel>
  );
}
