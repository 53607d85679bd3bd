//! Ground truth: a path tracer against which everything else is measured, and which captures are made with.
//!
//! Unidirectional paths with next-event estimation (sky, area and point lights, chosen by power) and multiple importance sampling
//! (Veach 1997), over a four-wide tree built by `obvhs`. Surfaces are two-sided; area lights shine from the side that their
//! normals point to. Materials: Lambert (constant or textured), mirror, any of `radiometry::brdf`, and
//! Ashikhmin & Shirley's with textures for parameters.
//!
//! Fails slowly where its sampling has no answer: caustics of small lights through mirrors, and point lights seen in mirrors
//! (which have no extent to be hit: their caustics are missing).

mod bvh;
mod coherence;
mod distribution;
#[expect(unsafe_code, reason = "AVX2 behind a question to the processor; audited there")]
mod lanes;
mod lights;
mod low_discrepancy;
mod memory;
mod packets;
mod path;
mod render;
mod scattering;
mod sky;
mod sky_cells;
mod surfaces;
mod tracer;
mod traverse;
mod warp;

#[cfg(test)]
mod tests;

pub(crate) use bvh::Bvh;
pub(crate) use low_discrepancy::SampleSequence;
pub use memory::{texture_bytes, working_bytes};
pub use render::{Seen, TraceSettings, TracedImage};
pub use tracer::{Appearance, Hit, Mirrors, TraceError, Tracer, Under};
pub(crate) use traverse::Stack;
