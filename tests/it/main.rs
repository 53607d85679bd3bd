//! Tests through the real binaries and the real port, and tests of the repository's own rules. One binary: one link.
//!
//! The binaries must be built: `tests/run` does, or `cargo build --workspace --bins`.

mod bad_input;
mod cache;
mod clients;
mod command_line;
mod counters;
mod downloads;
mod environments;
mod killed;
mod load;
mod main_flow;
mod memory;
mod paper_tables;
mod parameter_map;
mod prefetch;
mod process;
mod rules;
mod stopping;
mod sweep;
mod system;
mod thin;
mod tiny;
mod uploads;
mod wire;
