//! Tests through the real binaries and the real port, and tests of the repository's own rules. One binary: one link.
//!
//! The binaries must be built: `tests/run` does, or `cargo build --workspace --bins --examples`.

mod bad_input;
mod cache;
mod calibration;
mod clients;
mod command_line;
mod counters;
mod downloads;
mod environments;
mod exposure;
mod fits;
mod fuzz;
mod ground_truth;
mod grpc_web;
mod killed;
mod larger_than_memory;
mod load;
mod lost_device;
mod main_flow;
mod measured;
mod memory;
mod moving;
mod paper_tables;
mod parameter_map;
mod photographs;
mod pictures;
mod prefetch;
mod process;
mod python;
mod reflections;
mod relay;
mod replace;
mod rules;
mod sessions;
mod stills;
mod stopping;
mod streaming;
mod sweep;
mod system;
mod terminal;
mod thin;
mod tiny;
mod uploads;
mod viewers;
mod wire;
