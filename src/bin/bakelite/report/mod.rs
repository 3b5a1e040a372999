//! `bakelite report`: measurements, with tables, plots and CSV.
//!
//! | file | what it measures |
//! |---|---|
//! | `cancel` | how long calls are silent, and how soon they end when cancelled |
//! | `coherence` | rates of rays by tree, way and coherence against the number of triangles |
//! | `edits` | light after an object has moved: what changed, beside a bake from nothing |
//! | `live` | live updates: error against time and rays, budgets, traffic |
//! | `memory` | a scene's memory by part, and what little of it costs rays |
//! | `pipeline` | the stages of a bake, and what bounds each |
//! | `quality` | error of the light against run time |
//! | `scaling` | time, memory and rates of rays against the number of triangles |
//! | `stability` | stiff and extreme cases against what is known of them |
//! | `measure` | what they share |

pub mod cancel;
pub mod coherence;
pub mod edits;
pub mod live;
mod measure;
pub mod memory;
pub mod pipeline;
pub mod quality;
pub mod scaling;
pub mod stability;
