//! Instances, meshes that stand in the scene several times, and the objects that a scene consists of.

use super::{Mesh, check_finite};
use crate::base::error::{Result, invalid_argument};
use glam::{Affine3A, DMat3, DVec3, Mat3A, Vec3, Vec3A};

/// One placement of a mesh. A mesh that has instances stands in the scene where they say, and nowhere else; its
/// vertices and its tree exist once.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Instance {
    /// Number of the mesh.
    pub mesh: u32,
    /// Map from the mesh's coordinates to those of the scene.
    pub transform: Affine3A,
    /// Number of another instance of the mesh, less than that of this one, whose texels and light this one shows; `None`: it has
    /// some of its own.
    pub light_of: Option<u32>,
}

/// Least volume of the box that the images of the axes span, as a fraction of the product of their lengths: with a
/// smaller one, transformed rays have too few digits.
const LEAST_VOLUME: f64 = 1e-3;

/// Least [`Instance::margin`].
const LEAST_MARGIN: f32 = 1e-6;

/// Number of roundings, relative to coordinates, that transforming a ray to a mesh goes through: five of its origin, four of its
/// direction, and one to spare.
const ROUNDINGS: f32 = 10.0;

impl Instance {
    /// An instance with light of its own.
    pub fn new(mesh: u32, transform: Affine3A) -> Instance {
        Instance { mesh, transform, light_of: None }
    }

    /// Checks that the transform is finite, can be inverted and does not mirror.
    pub fn validate(&self, mesh_count: usize) -> Result<()> {
        if self.mesh as usize >= mesh_count {
            return invalid_argument!("the instance names mesh {}, the scene has {mesh_count}", self.mesh);
        }
        check_finite("the transform", &self.transform.to_cols_array())?;
        let axes = DMat3::from_cols(
            self.transform.matrix3.x_axis.as_dvec3(),
            self.transform.matrix3.y_axis.as_dvec3(),
            self.transform.matrix3.z_axis.as_dvec3(),
        );
        let lengths = axes.x_axis.length() * axes.y_axis.length() * axes.z_axis.length();
        let volume = axes.determinant();
        if volume < 0.0 {
            return invalid_argument!("the transform mirrors (determinant {volume:e}); add a mirrored mesh instead");
        }
        let inverse = Mat3A::from(axes.inverse().as_mat3());
        if !(volume >= LEAST_VOLUME * lengths && volume > 0.0 && inverse.is_finite()) {
            return invalid_argument!("the transform cannot be inverted with enough digits (determinant {volume:e})");
        }
        Ok(())
    }

    /// Returns the largest coordinate that placing a point of a box of the mesh goes through.
    pub(super) fn reach(&self, (lower, upper): (Vec3, Vec3)) -> f32 {
        let (m, far) = (&self.transform.matrix3, Vec3A::from(lower.abs().max(upper.abs())));
        let terms = m.x_axis.abs() * far.x + m.y_axis.abs() * far.y + m.z_axis.abs() * far.z;
        (terms + self.transform.translation.abs()).max_element()
    }

    /// Returns the greatest extent of the image of a box of the mesh.
    pub(super) fn extent(&self, (lower, upper): (Vec3, Vec3)) -> f32 {
        let (m, size) = (&self.transform.matrix3, Vec3A::from(upper - lower));
        (m.x_axis.abs() * size.x + m.y_axis.abs() * size.y + m.z_axis.abs() * size.z).max_element()
    }

    /// Returns by how much a ray in the mesh's coordinates may lie beside where it is in the scene, as a fraction of the
    /// coordinates and extents that it goes through: at least some ten roundings. The boxes of instances and the rays that
    /// are tested against them are wider by that, so that no ray enters a box behind what it hits in the instance, and hits
    /// do not depend on which instance comes first. (The condition of Skeel, *Scaling for Numerical Stability in Gaussian
    /// Elimination*, 1979: 1 for scaling along the axes, up to 3 for rotations, more for shears.)
    pub(crate) fn margin(&self) -> f32 {
        let m = &self.transform.matrix3;
        let m = DMat3::from_cols(m.x_axis.as_dvec3(), m.y_axis.as_dvec3(), m.z_axis.as_dvec3());
        let abs = |m: DMat3| DMat3::from_cols(m.x_axis.abs(), m.y_axis.abs(), m.z_axis.abs());
        let condition = (abs(m) * abs(m.inverse()) * DVec3::ONE).max_element() as f32;
        LEAST_MARGIN.max(ROUNDINGS * f32::EPSILON / 2.0 * condition)
    }

    /// Returns the map of vectors from the scene's coordinates to those of the mesh.
    pub(crate) fn to_mesh(self) -> Mat3A {
        let Affine3A { matrix3: m, .. } = self.transform;
        let inverse = DMat3::from_cols(m.x_axis.as_dvec3(), m.y_axis.as_dvec3(), m.z_axis.as_dvec3()).inverse();
        Mat3A::from(inverse.as_mat3())
    }
}

/// Something that stands in the scene: a mesh without instances, or an instance of a mesh. Objects are numbered: first
/// all meshes (one with instances is an object without triangles), then the instances.
#[derive(Clone, Copy)]
pub struct Object<'a> {
    mesh: &'a Mesh,
    transform: Option<&'a Affine3A>,
}

impl<'a> Object<'a> {
    #[inline]
    pub(super) fn new(mesh: &'a Mesh, transform: Option<&'a Affine3A>) -> Self {
        Object { mesh, transform }
    }

    /// The mesh, in coordinates of its own if this is an instance.
    #[inline]
    pub fn mesh(&self) -> &'a Mesh {
        self.mesh
    }

    /// Whether this is an instance of its mesh.
    pub fn is_instance(&self) -> bool {
        self.transform.is_some()
    }

    /// The position of a vertex in the scene.
    #[inline]
    pub fn position(&self, vertex: u32) -> Vec3 {
        let position = self.mesh.positions[vertex as usize];
        match self.transform {
            None => position,
            Some(t) => placed(t, position),
        }
    }

    /// The corners of a triangle in the scene.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Vec3; 3] {
        let corners = self.mesh.corners(triangle as usize);
        match self.transform {
            None => corners,
            Some(t) => corners.map(|c| placed(t, c)),
        }
    }

    /// The shading normal of a vertex in the scene: of an instance a unit vector or 0, else as it was given. The mesh
    /// must have normals.
    #[inline]
    pub fn normal(&self, vertex: u32) -> Vec3 {
        let normal = self.mesh.normals[vertex as usize];
        match self.transform {
            None => normal,
            Some(t) => {
                // The cofactors: the transposed inverse but for a positive factor.
                let Mat3A { x_axis: x, y_axis: y, z_axis: z } = t.matrix3;
                let n = Vec3A::from(normal.normalize_or_zero());
                Vec3::from(y.cross(z) * n.x + z.cross(x) * n.y + x.cross(y) * n.z).normalize_or_zero()
            }
        }
    }

    /// Whether another state of the object stands in the same place, bit for bit.
    pub(crate) fn stands_as(&self, other: &Object) -> bool {
        let bits = |o: &Object| o.transform.map(|t| t.to_cols_array().map(f32::to_bits));
        let (here, there) = (&self.mesh.positions[..], &other.mesh.positions[..]);
        bits(self) == bits(other)
            && (std::ptr::eq(here, there)
                || bytemuck::cast_slice::<_, u32>(here) == bytemuck::cast_slice::<_, u32>(there))
    }

    /// The object as a mesh that stands where it does.
    pub fn flattened(&self) -> Mesh {
        let mut mesh = self.mesh.clone();
        if self.transform.is_some() {
            let all = 0..mesh.positions.len() as u32;
            mesh.positions = all.clone().map(|v| self.position(v)).collect();
            if !mesh.normals.is_empty() {
                mesh.normals = all.map(|v| self.normal(v)).collect();
            }
            mesh.lightmap = None;
        }
        mesh
    }
}

/// The image of a point: f32 operations in a fixed order, the same on every machine.
#[inline]
pub(super) fn placed(t: &Affine3A, p: Vec3) -> Vec3 {
    let m = &t.matrix3;
    Vec3::from(m.x_axis * p.x + m.y_axis * p.y + m.z_axis * p.z + t.translation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    fn of(transform: Affine3A) -> Instance {
        Instance::new(0, transform)
    }

    #[test]
    fn transforms_that_lose_digits_or_mirror_are_refused_by_name() {
        let turned = Affine3A::from_scale_rotation_translation(
            Vec3::new(1e-3, 2.0, 50.0),
            Quat::from_rotation_y(1.0),
            Vec3::splat(1e3),
        );
        assert_eq!(of(turned).validate(1), Ok(()));
        let refused = |i: Instance, part: &str| {
            let message = i.validate(1).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        };
        refused(Instance { mesh: 1, ..of(turned) }, "mesh 1");
        refused(of(Affine3A::from_scale(Vec3::new(1.0, -1.0, 1.0))), "mirrors");
        refused(of(Affine3A::from_scale(Vec3::new(1.0, 0.0, 1.0))), "cannot be inverted");
        refused(of(Affine3A::from_translation(Vec3::new(0.0, f32::NAN, 0.0))), "NaN");
        refused(of(Affine3A::from_scale(Vec3::splat(1e-39))), "cannot be inverted");
        let mut sheared = Affine3A::IDENTITY;
        sheared.matrix3.y_axis = Vec3A::new(1.0, 1e-5, 0.0);
        refused(of(sheared), "cannot be inverted");
    }

    #[test]
    fn normals_stay_perpendicular_to_their_surface() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.0, 1.0, 1.0)].into(),
            indices: vec![[0, 1, 2]].into(),
            normals: vec![Vec3::new(0.0, -3.0, 3.0); 3].into(),
            ..Default::default()
        };
        let t = Affine3A::from_scale_rotation_translation(
            Vec3::new(0.2, 3.0, 1.0),
            Quat::from_rotation_x(0.7),
            Vec3::new(1.0, 2.0, 3.0),
        );
        let object = Object::new(&mesh, Some(&t));
        let [a, b, c] = object.corners(0);
        let (normal, geometric) = (object.normal(1), (b - a).cross(c - a).normalize());
        assert!(normal.dot(geometric) > 1.0 - 1e-6, "{normal} {geometric}");
        assert_eq!((object.position(2), object.is_instance()), (c, true));
    }
}
