/**
 * What is shown and how, by dataset kind: one table of fields, from which the panel, the link and the wire's messages are made. A field's
 * value is text or a number; what a server makes of it is the server's to judge.
 */

/** Kinds that this page can show. */
export type Kind = 'offset_surface_light_field' | 'parameter_map';

/** The kinds' names for people. */
export const KIND_NAMES: Readonly<Record<string, string>> = {
  offset_surface_light_field: 'offset surface light field',
  parameter_map: 'parameter map',
  observation_map: 'observation map',
};

export function isKind(kind: string): kind is Kind {
  return kind === 'offset_surface_light_field' || kind === 'parameter_map';
}

/** What one picture shows. */
export interface Settings {
  /** "stored", or "truth": what the others should show, path traced. */
  readonly source: string;
  /** Of truth at rest: it is the mean of so many. */
  readonly truthPasses: number;
  readonly component: string;
  readonly blend: string;
  readonly exponent: number;
  readonly specularRed: number;
  readonly specularGreen: number;
  readonly specularBlue: number;
  readonly filter: string;
  readonly brdf: string;
  readonly directions: number;
  /** Whether sample points are blended direction by direction, or integrated one by one. */
  readonly integrationOrder: string;
  /** Of a glossy picture at rest: it is the mean of so many. */
  readonly passes: number;
  /** Degrees about +Y by which the light from infinity is turned. */
  readonly environmentTurn: number;
  /** Point lights more, `X,Y,Z:R,G,B` each, separated by spaces. */
  readonly pointLights: string;
  /** Of a mirror, one after the other. */
  readonly reflections: number;
  /** Of a clear body. */
  readonly refractionIndex: number;
  readonly body: string;
  readonly show: string;
  readonly exposureStops: number;
  readonly exposureGamma: number;
  readonly overlay: string;
}

/** How pictures come here: of both halves of a split view. */
export interface Delivery {
  readonly encoding: string;
  /** Of the last frame of a viewer at rest: "same" or "png". */
  readonly atRest: string;
  readonly quality: number;
  /** Picture pixels: of a CSS pixel's side, or 0 for the device's own. */
  readonly scale: number;
  /** Frames per second asked for while moving. */
  readonly rate: number;
  /** Whether the last frame is warped to the newest pose while the next is awaited: "off", "depth", or "auto": where the link is long. */
  readonly warp: string;
}

/** A choice's value and its name for people. */
export type Option = readonly [value: string, label: string];

interface Common<T> {
  readonly key: keyof T & string;
  readonly label: string;
  readonly hint?: string;
  /** Whether the field changes anything. */
  readonly applies: (values: T, kind: Kind) => boolean;
}

/** One setting and its control. */
export type Field<T> = Common<T> &
  (
    | { readonly control: 'choice'; readonly options: readonly Option[] }
    | { readonly control: 'range' | 'number'; readonly least: number; readonly most: number; readonly step: number }
    | { readonly control: 'text'; readonly presets: readonly Option[] }
  );

export const DEFAULT_SETTINGS: Settings = {
  source: 'stored',
  truthPasses: 64,
  component: 'reconstruction',
  blend: 'corrected',
  exponent: 4,
  specularRed: 0.5,
  specularGreen: 0.5,
  specularBlue: 0.5,
  filter: 'footprint',
  brdf: '{"model": "cook_torrance", "alpha_x": 0.1, "alpha_y": 0.3, "f0": [0.95, 0.64, 0.54]}',
  directions: 0,
  integrationOrder: 'blend-first',
  passes: 16,
  environmentTurn: 0,
  pointLights: '',
  reflections: 1,
  refractionIndex: 1.5,
  body: 'solid',
  show: 'radiance',
  exposureStops: 0,
  exposureGamma: 0,
  overlay: 'none',
};

export const DEFAULT_DELIVERY: Delivery = { encoding: 'jpeg', atRest: 'same', quality: 90, scale: 1, rate: 30, warp: 'auto' };

const isLightField = (kind: Kind): boolean => kind === 'offset_surface_light_field';
const showsComponent =
  (...components: string[]) =>
  (values: Settings, kind: Kind): boolean =>
    isLightField(kind) && components.includes(values.component);
const isStored = (values: Settings): boolean => values.source === 'stored';
/** Of how what is stored is read: nothing of it is in a truth. */
const reads =
  (applies: (values: Settings, kind: Kind) => boolean) =>
  (values: Settings, kind: Kind): boolean =>
    isStored(values) && applies(values, kind);

/** Two refreshes of most screens: over a link that takes no longer there and back, the frame itself comes as soon as a warp helps. */
const LONG_ROUND_TRIP_MILLIS = 33;

/** As it is over a link of this round trip, which decides where nobody did. */
export function decided(delivery: Delivery, roundTripMillis: number): Delivery {
  if (delivery.warp !== 'auto') return delivery;
  return { ...delivery, warp: roundTripMillis > LONG_ROUND_TRIP_MILLIS ? 'depth' : 'off' };
}

/** Passes of a picture at rest. */
export function passesOf(settings: Settings): number {
  return isStored(settings) ? settings.passes : settings.truthPasses;
}

/** What these settings should show. */
export function truthOf(settings: Settings): Settings {
  return { ...settings, source: 'truth', overlay: 'none' };
}

export const SETTING_FIELDS: readonly Field<Settings>[] = [
  {
    key: 'source',
    label: 'Source',
    control: 'choice',
    options: [
      ['stored', 'as stored'],
      ['truth', 'ground truth'],
    ],
    applies: () => true,
  },
  {
    key: 'truthPasses',
    label: 'Paths at rest',
    hint: 'Traced from the scene, a path a pixel in each pass: noise goes.',
    control: 'number',
    least: 1,
    most: 4096,
    step: 1,
    applies: (values) => !isStored(values),
  },
  {
    key: 'component',
    label: 'Component',
    control: 'choice',
    options: [
      ['reconstruction', 'reconstruction'],
      ['mirror', 'mirror'],
      ['full', 'both'],
      ['glossy', 'glossy BRDF'],
      ['refraction', 'clear body'],
    ],
    applies: (_, kind) => isLightField(kind),
  },
  {
    key: 'blend',
    label: 'Blend',
    control: 'choice',
    options: [
      ['corrected', 'corrected'],
      ['normal', 'normal'],
      ['reflection', 'reflection'],
      ['distance', 'distance'],
      ['angle', 'angle'],
      ['average', 'average'],
      ['environment-map', 'environment map'],
    ],
    applies: reads((_, kind) => isLightField(kind)),
  },
  {
    key: 'exponent',
    label: 'Exponent N',
    control: 'number',
    least: 0,
    most: 10000,
    step: 0.1,
    applies: reads(
      (values, kind) =>
        showsComponent('mirror', 'full', 'glossy', 'refraction')(values, kind) &&
        (values.blend === 'normal' || values.blend === 'reflection'),
    ),
  },
  ...(['Red', 'Green', 'Blue'] as const).map(
    (channel): Field<Settings> => ({
      key: `specular${channel}`,
      label: `Specular reflectance, ${channel.toLowerCase()}`,
      control: 'range',
      least: 0,
      most: 1,
      step: 0.01,
      applies: showsComponent('mirror', 'full'),
    }),
  ),
  {
    key: 'reflections',
    label: 'Reflections',
    hint: 'From the second on it sees itself.',
    control: 'number',
    least: 1,
    most: 4,
    step: 1,
    applies: showsComponent('mirror', 'full'),
  },
  {
    key: 'brdf',
    label: 'BRDF',
    control: 'text',
    presets: [
      ['{"model": "cook_torrance", "alpha_x": 0.1, "alpha_y": 0.3, "f0": [0.95, 0.64, 0.54]}', 'brushed copper'],
      ['{"model": "cook_torrance", "alpha_x": 0.1, "alpha_y": 0.1, "f0": [0.9, 0.7, 0.3]}', 'gold'],
      [
        '{"model": "ashikhmin_shirley", "diffuse": [0, 0, 0], "specular": [0.9, 0.9, 0.9], "exponent_u": 100, "exponent_v": 1000}',
        'brushed silver',
      ],
      ['{"model": "lambert", "albedo": [0.8, 0.8, 0.8]}', 'matt white'],
    ],
    applies: showsComponent('glossy'),
  },
  {
    key: 'directions',
    label: 'Directions a pixel',
    hint: '0: as many as the BRDF needs; one look where its highlight is narrow.',
    control: 'number',
    least: 0,
    most: 4096,
    step: 1,
    applies: reads(showsComponent('glossy')),
  },
  {
    key: 'integrationOrder',
    label: 'Order',
    hint: 'Corrected reads are always blended first.',
    control: 'choice',
    options: [
      ['blend-first', 'blend, then integrate'],
      ['integrate-first', 'integrate, then blend'],
    ],
    applies: reads(showsComponent('glossy')),
  },
  {
    key: 'passes',
    label: 'Passes at rest',
    hint: 'Each adds as many directions: noise and blur go.',
    control: 'number',
    least: 1,
    most: 256,
    step: 1,
    applies: reads(showsComponent('glossy')),
  },
  {
    key: 'refractionIndex',
    label: 'Index of refraction',
    control: 'range',
    least: 1,
    most: 4,
    step: 0.01,
    applies: showsComponent('refraction'),
  },
  {
    key: 'body',
    label: 'Body',
    control: 'choice',
    options: [
      ['solid', 'solid'],
      ['thin', 'thin shell'],
    ],
    applies: showsComponent('refraction'),
  },
  {
    key: 'environmentTurn',
    label: 'Environment turned, °',
    control: 'range',
    least: -180,
    most: 180,
    step: 1,
    applies: (_, kind) => isLightField(kind),
  },
  {
    key: 'pointLights',
    label: 'Point lights',
    hint: 'Place and intensity, X,Y,Z:R,G,B each.',
    control: 'text',
    presets: [
      ['', 'none'],
      ['3,17,4:100,80,60', 'one, over the gazebo’s table'],
      ['6,15,2:120,50,20 -6,15,2:20,50,120', 'two, warm and cold'],
    ],
    applies: showsComponent('reconstruction', 'full', 'glossy'),
  },
  {
    key: 'filter',
    label: 'Filter',
    control: 'choice',
    options: [
      ['footprint', 'footprint'],
      ['bilinear', 'bilinear'],
    ],
    applies: reads((_, kind) => isLightField(kind)),
  },
  {
    key: 'show',
    label: 'Show',
    control: 'choice',
    options: [
      ['radiance', 'radiance'],
      ['models', 'models'],
      ['flags', 'flags'],
    ],
    applies: (_, kind) => kind === 'parameter_map',
  },
  {
    key: 'exposureStops',
    label: 'Exposure, stops',
    control: 'range',
    least: -8,
    most: 8,
    step: 0.25,
    applies: () => true,
  },
  {
    key: 'exposureGamma',
    label: 'Exposure γ',
    hint: 'Shows 1 − exp(−γ L); 0 clips at 1.',
    control: 'range',
    least: 0,
    most: 8,
    step: 0.1,
    applies: () => true,
  },
  {
    key: 'overlay',
    label: 'Provenance',
    hint: 'Amber: filled by a fallback. Magenta: unknown. Samples: a colour each.',
    control: 'choice',
    options: [
      ['none', 'off'],
      ['state', 'filled and unknown'],
      ['samples', 'samples'],
    ],
    applies: reads(() => true),
  },
];

export const DELIVERY_FIELDS: readonly Field<Delivery>[] = [
  {
    key: 'encoding',
    label: 'Encoding',
    control: 'choice',
    options: [
      ['jpeg', 'JPEG'],
      ['png', 'PNG (lossless)'],
      ['h264', 'H.264'],
    ],
    applies: () => true,
  },
  {
    key: 'atRest',
    label: 'At rest',
    control: 'choice',
    options: [
      ['same', 'the same'],
      ['png', 'PNG (lossless)'],
    ],
    applies: (values) => values.encoding !== 'png',
  },
  {
    key: 'quality',
    label: 'Quality',
    control: 'range',
    least: 10,
    most: 100,
    step: 1,
    applies: (values) => values.encoding !== 'png',
  },
  {
    key: 'scale',
    label: 'Resolution',
    control: 'choice',
    options: [
      ['0', 'of the device'],
      ['1', '1'],
      ['0.5', '½'],
      ['0.25', '¼'],
    ],
    applies: () => true,
  },
  {
    key: 'rate',
    label: 'Frames/s moving',
    control: 'number',
    least: 1,
    most: 240,
    step: 1,
    applies: () => true,
  },
  {
    key: 'warp',
    label: 'While waiting',
    hint: 'Far: more than 33 ms there and back.',
    control: 'choice',
    options: [
      ['auto', 'warp if far'],
      ['off', 'keep the frame'],
      ['depth', 'warp by depth'],
    ],
    applies: () => true,
  },
];

/** The same for a server or a browser that has no H.264. */
export const DELIVERY_FIELDS_WITHOUT_VIDEO: readonly Field<Delivery>[] = DELIVERY_FIELDS.map((field) =>
  field.key === 'encoding' && field.control === 'choice'
    ? { ...field, options: field.options.filter(([value]) => value !== 'h264') }
    : field,
);

/** The value that a text means for this field; undefined where it means none. */
export function parsed<T>(field: Field<T>, sample: T[keyof T & string], text: string): string | number | undefined {
  switch (field.control) {
    case 'text':
      return text;
    case 'choice':
      if (!field.options.some(([value]) => value === text)) return undefined;
      return typeof sample === 'number' ? Number(text) : text;
    case 'range':
    case 'number': {
      const number = text.trim() === '' ? Number.NaN : Number(text);
      // The wire has whole numbers where the step is one.
      const isWhole = field.step !== 1 || Number.isInteger(number);
      return isWhole && number >= field.least && number <= field.most ? number : undefined;
    }
  }
}
