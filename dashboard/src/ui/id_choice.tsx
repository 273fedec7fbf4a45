/** A choice among what has ids: tools, frames. */

interface IdChoiceProps {
  label: string;
  /** Empty: the first entry, where there is `none`. */
  value: string;
  among: readonly { readonly id: string }[];
  choose: (id: string) => void;
  /** What the empty id is called; left out: it cannot be chosen. */
  none?: string;
  /** An id that is left out. */
  without?: string;
}

export function IdChoice({ label, value, among, choose, none, without }: IdChoiceProps) {
  return (
    <label>
      {label}{" "}
      <select value={value} onChange={({ currentTarget }) => choose(currentTarget.value)}>
        {none === undefined ? null : <option value="">{none}</option>}
        {among
          .filter(({ id }) => id !== without)
          .map(({ id }) => (
            <option key={id} value={id}>
              {id}
            </option>
          ))}
      </select>
    </label>
  );
}
