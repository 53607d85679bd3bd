//! Tests through the real binaries and the real port, and tests of the repository's own rules. One binary: one link.

mod rules;
