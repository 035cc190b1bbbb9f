// An error in one card or layer never takes another: it is reported until that part works again, and the rest goes on.

const reported = new Map();
let tell = () => {};

export const onFault = (listener) => { tell = listener; };

export function guarded(name, work) {
  return (...values) => {
    try {
      const result = work(...values);
      if (reported.delete(name)) tell(name, null);
      return result;
    } catch (error) {
      const text = `${name}: ${error?.message ?? error}`;
      if (reported.get(name) !== text) {
        reported.set(name, text);
        console.warn(text, error);
        tell(name, text);
      }
      return undefined;
    }
  };
}
