/** Stands where a device would be shown: says why there is none. */

import { devices, missing } from "../devices";
import { text } from "../text";

export function NoDevice() {
  return <p class="muted">{devices.value === null ? text.loading : missing.value === null ? text.device.none : text.device.gone(missing.value)}</p>;
}
