/** Controls of a table of fields: built once, so that focus stays where it is; a field that changes nothing is hidden. */
import { make, select } from './dom';
import { parsed, type Field, type Kind } from './settings';

/** Controls for one set of values. */
export interface Controls<T> {
  readonly element: HTMLElement;
  /** Shows these values. */
  show(values: T): void;
}

/** Of presets: a text that is none of them. Never a preset's own text, which may be empty. */
const OWN = 'own';

type Input = HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement;

interface Row<T> {
  readonly field: Field<T>;
  readonly element: HTMLElement;
  readonly input: Input;
  readonly shown: (value: string) => void;
}

/** `prefix` makes ids unique; `change` gets the new values. */
export function controls<T extends object>(
  fields: readonly Field<T>[],
  kind: Kind,
  prefix: string,
  initial: T,
  change: (values: T) => void,
): Controls<T> {
  let values = initial;
  const rows = fields.map((field) => row(field, prefix));
  const show = (next: T): void => {
    values = next;
    for (const { field, element, input, shown } of rows) {
      element.hidden = !field.applies(values, kind);
      const text = String(values[field.key]);
      if (input.value !== text) input.value = text;
      input.removeAttribute('aria-invalid');
      shown(text);
    }
  };
  for (const { field, input } of rows) {
    const take = (): void => {
      const value = parsed(field, values[field.key], input.value);
      if (value === undefined) {
        input.setAttribute('aria-invalid', 'true');
      } else if (value !== values[field.key]) {
        show({ ...values, [field.key]: value });
        change(values);
      }
    };
    // Text is taken once it is finished, sliders while they move.
    input.addEventListener(field.control === 'range' ? 'input' : 'change', take);
  }
  show(values);
  return { element: make('div', { class: 'fields' }, ...rows.map(({ element }) => element)), show };
}

function row<T>(field: Field<T>, prefix: string): Row<T> {
  const id = `${prefix}-${field.key}`;
  const { nodes, input, shown } = control(field, id);
  const element = make('div', { class: `field ${field.control}` }, make('label', { for: id }, field.label), ...nodes);
  if (field.hint !== undefined) {
    element.append(make('small', { id: `${id}-hint` }, field.hint));
    input.setAttribute('aria-describedby', `${id}-hint`);
  }
  return { field, element, input, shown };
}

function control<T>(field: Field<T>, id: string): { nodes: Node[]; input: Input; shown: (value: string) => void } {
  switch (field.control) {
    case 'choice': {
      const input = select(field.options, { id });
      return { nodes: [input], input, shown: () => undefined };
    }
    case 'range': {
      const input = make('input', { id, type: 'range', min: field.least, max: field.most, step: field.step });
      const output = make('output', { for: id });
      return { nodes: [output, input], input, shown: (value) => (output.textContent = value) };
    }
    case 'number': {
      const input = make('input', { id, type: 'number', min: field.least, max: field.most, step: field.step });
      return { nodes: [input], input, shown: () => undefined };
    }
    case 'text': {
      const input = make('textarea', { id, rows: 4, spellcheck: 'false' });
      const presets = select([...field.presets, [OWN, 'own']], { 'aria-label': `${field.label}, presets` });
      presets.addEventListener('change', () => {
        if (presets.value === OWN) {
          input.focus();
          return;
        }
        input.value = presets.value;
        input.dispatchEvent(new Event('change'));
      });
      const shown = (value: string): void => {
        presets.value = field.presets.some(([preset]) => preset === value) ? value : OWN;
      };
      return { nodes: [presets, input], input, shown };
    }
  }
}
