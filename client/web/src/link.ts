/**
 * The page's address: dataset, version, camera and settings, as `#d=teapot&v=1&az=30&…`. Angles in degrees; only what differs from the
 * defaults is written. What cannot be read is an error that names it, never a silent default.
 */
import { FIELD_OF_VIEW_RANGE, type Viewpoint } from './camera';
import {
  DEFAULT_DELIVERY,
  DEFAULT_SETTINGS,
  DELIVERY_FIELDS,
  parsed,
  SETTING_FIELDS,
  type Delivery,
  type Field,
  type Settings,
} from './settings';
import type { Vector3 } from './vector';

/** How two settings are shown together. */
export type Split = 'none' | 'side' | 'wipe' | 'error';

/** All that a link reproduces. */
export interface Address {
  readonly dataset: string;
  /** 0: the latest. */
  readonly version: number;
  /** Absent: the dataset's own. */
  readonly viewpoint: Viewpoint | undefined;
  readonly settings: Settings;
  readonly delivery: Delivery;
  readonly split: Split;
  /** Of the second picture. */
  readonly other: Settings;
}

const DEGREE = Math.PI / 180;
/** More than f32 keeps, so that a link's pixels are the view's. */
const DIGITS = 9;
const OTHER_PREFIX = 'b.';

/** Of a dataset that is opened from the list. */
export function addressOf(dataset: string): Address {
  return {
    dataset,
    version: 0,
    viewpoint: undefined,
    settings: DEFAULT_SETTINGS,
    delivery: DEFAULT_DELIVERY,
    split: 'none',
    other: DEFAULT_SETTINGS,
  };
}

/** The hash, with its `#`. */
export function written(address: Address): string {
  const words = new URLSearchParams({ d: address.dataset });
  if (address.version !== 0) words.set('v', String(address.version));
  if (address.viewpoint !== undefined) {
    const { target, distance, azimuth, elevation, fieldOfView } = address.viewpoint;
    words.set('at', target.map(short).join(','));
    words.set('r', short(distance));
    words.set('az', short(azimuth / DEGREE));
    words.set('el', short(elevation / DEGREE));
    words.set('fov', short(fieldOfView / DEGREE));
  }
  write(words, '', SETTING_FIELDS, address.settings, DEFAULT_SETTINGS);
  write(words, '', DELIVERY_FIELDS, address.delivery, DEFAULT_DELIVERY);
  if (address.split !== 'none') {
    words.set('split', address.split);
    write(words, OTHER_PREFIX, SETTING_FIELDS, address.other, DEFAULT_SETTINGS);
  }
  // These need no escape in a fragment, and commas and braces read better bare.
  return `#${words.toString().replaceAll('%2C', ',').replaceAll('%3A', ':')}`;
}

/** Reads a hash; undefined for an empty one (the list of datasets). Throws a RangeError that names what cannot be read. */
export function read(hash: string): Address | undefined {
  const words = new URLSearchParams(hash.replace(/^#/, ''));
  if ([...words].length === 0) return undefined;
  const dataset = words.get('d') ?? '';
  if (dataset === '') throw new RangeError('the link names no dataset (d=…)');
  const split = words.get('split') ?? 'none';
  if (split !== 'none' && split !== 'side' && split !== 'wipe' && split !== 'error') {
    throw new RangeError(`split=${split}: none, side, wipe or error expected`);
  }
  const version = number(words, 'v', 0, Number.MAX_SAFE_INTEGER) ?? 0;
  if (!Number.isInteger(version)) throw new RangeError(`v=${version}: a whole number expected`);
  return {
    dataset,
    version,
    viewpoint: readViewpoint(words),
    settings: readFields(words, '', SETTING_FIELDS, DEFAULT_SETTINGS),
    delivery: readFields(words, '', DELIVERY_FIELDS, DEFAULT_DELIVERY),
    split,
    other: readFields(words, OTHER_PREFIX, SETTING_FIELDS, DEFAULT_SETTINGS),
  };
}

function readViewpoint(words: URLSearchParams): Viewpoint | undefined {
  if (!['at', 'r', 'az', 'el', 'fov'].some((key) => words.has(key))) return undefined;
  const need = (key: string, least: number, most: number): number => {
    const value = number(words, key, least, most);
    if (value === undefined) throw new RangeError(`the link's camera lacks ${key}`);
    return value;
  };
  const [least, most] = FIELD_OF_VIEW_RANGE;
  const target = (words.get('at') ?? '').split(',').map((text) => finite('at', text));
  if (target.length !== 3) throw new RangeError(`at=${words.get('at')}: three numbers expected`);
  return {
    target: target as unknown as Vector3,
    distance: need('r', Number.MIN_VALUE, 1e30),
    azimuth: need('az', -360, 360) * DEGREE,
    elevation: need('el', -90, 90) * DEGREE,
    // A degree's rounding must not push an end of the range out of it.
    fieldOfView: Math.min(Math.max(need('fov', least / DEGREE - 1e-6, most / DEGREE + 1e-6) * DEGREE, least), most),
  };
}

function write<T extends object>(words: URLSearchParams, prefix: string, fields: readonly Field<T>[], values: T, defaults: T): void {
  for (const { key } of fields) {
    if (values[key] !== defaults[key]) words.set(prefix + key, String(values[key]));
  }
}

function readFields<T extends object>(words: URLSearchParams, prefix: string, fields: readonly Field<T>[], defaults: T): T {
  const values = { ...defaults };
  for (const field of fields) {
    const text = words.get(prefix + field.key);
    if (text === null) continue;
    const value = parsed(field, defaults[field.key], text);
    if (value === undefined) throw new RangeError(`${prefix}${field.key}=${text}: ${expected(field)} expected`);
    values[field.key] = value as T[typeof field.key];
  }
  return values;
}

function expected<T>(field: Field<T>): string {
  switch (field.control) {
    case 'choice':
      return field.options.map(([value]) => value).join(', ');
    case 'text':
      return 'text';
    case 'range':
    case 'number':
      return `${field.least} to ${field.most}`;
  }
}

function number(words: URLSearchParams, key: string, least: number, most: number): number | undefined {
  const text = words.get(key);
  if (text === null) return undefined;
  const value = finite(key, text);
  if (value < least || value > most) throw new RangeError(`${key}=${text}: ${short(least)} to ${short(most)} expected`);
  return value;
}

function finite(key: string, text: string): number {
  const value = text.trim() === '' ? Number.NaN : Number(text);
  if (!Number.isFinite(value)) throw new RangeError(`${key}=${text}: a number expected`);
  return value;
}

function short(value: number): string {
  return String(Number(value.toPrecision(DIGITS)));
}
