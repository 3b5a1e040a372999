//! Direct light at points of surfaces, by shadow rays.

pub(crate) mod area_light;
pub(crate) mod direct_light;
pub(crate) mod guide;
mod light_node;
pub(crate) mod light_tree;
pub(crate) mod many_lights;
pub(crate) mod near_lights;
pub(crate) mod point_light;
mod polygon;
pub(crate) mod receiver;
pub(crate) mod shadow_rays;
mod shadow_terminator;
mod spherical_triangle;
pub(crate) mod sun_sky;

pub use direct_light::DirectLight;
pub use receiver::Receiver;
