//! Reading light maps out: pages layer by layer, UVs, and filtered lookups as a shader would do.

use super::atlas::ids::{ChartId, LightTexel};
use super::atlas::texels::PageArea;
use super::indirect::radiance_map::RadianceLookup;
use super::indirect::texel_albedo::albedo;
use super::{Half, Layer, LayerData, Light, Lightmap, Spread, TexelState};
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_vec, try_with_capacity};
use crate::direct::DirectLight;
use crate::scene::NONE;
use crate::trace::RawHit;
use glam::Vec3;

/// Validity of a texel that is filled from its neighbours.
const FILLED: f32 = 0.5;

/// UVs of the corners of each triangle, and its page.
pub type MeshUvs = (Vec<[[f32; 2]; 3]>, Vec<u32>);

impl Light {
    /// What several passes tell of the light.
    fn spread(&self) -> Result<&[Spread]> {
        if self.spread.is_empty() {
            let what = "the light map was baked in one pass, which tells no error and has no halves";
            return Err(Error::InvalidState(what.into()));
        }
        Ok(&self.spread)
    }
}

impl Lightmap {
    /// Returns the light map UV in [0, 1] of each corner, and the page of each triangle of `mesh`. Triangles without
    /// texels (degenerate ones) have page [`NONE`] and UVs 0.
    pub fn mesh_uvs(&self, mesh: u32) -> Result<MeshUvs> {
        self.object_uvs(self.object_of_mesh(mesh)?)
    }

    /// Returns what [`mesh_uvs`](Self::mesh_uvs) returns, of an instance: each has a place of its own in the light map, unless it shows the light of
    /// another one.
    pub fn instance_uvs(&self, instance: u32) -> Result<MeshUvs> {
        self.object_uvs(self.object_of_instance(instance)?)
    }

    /// Returns UVs and pages for the backs of `mesh`'s triangles, and for each triangle whether its back has separate
    /// texels. Backs without separate texels share those of the front.
    pub fn mesh_back_uvs(&self, mesh: u32) -> Result<(MeshUvs, Vec<bool>)> {
        self.object_back_uvs(self.object_of_mesh(mesh)?)
    }

    /// Returns what [`mesh_back_uvs`](Self::mesh_back_uvs) returns, of an instance.
    pub fn instance_back_uvs(&self, instance: u32) -> Result<(MeshUvs, Vec<bool>)> {
        self.object_back_uvs(self.object_of_instance(instance)?)
    }

    fn object_of_mesh(&self, mesh: u32) -> Result<u32> {
        let scene = &self.atlas.scene;
        let count = scene.meshes().len();
        if mesh as usize >= count {
            return invalid_argument!("mesh {mesh} does not exist, the scene has {count}");
        }
        if scene.is_instanced(mesh) {
            return invalid_argument!("mesh {mesh} stands in the scene through its instances: ask for theirs");
        }
        Ok(mesh)
    }

    fn object_of_instance(&self, instance: u32) -> Result<u32> {
        let count = self.atlas.scene.instances().len();
        if instance as usize >= count {
            return invalid_argument!("instance {instance} does not exist, the scene has {count}");
        }
        Ok(self.atlas.scene.object_of_instance(instance))
    }

    /// Returns what [`mesh_uvs`](Self::mesh_uvs) returns, of an [object](crate::scene::Object) that exists.
    pub fn object_uvs(&self, object: u32) -> Result<MeshUvs> {
        self.uvs_of(object, true)
    }

    /// Returns what [`mesh_back_uvs`](Self::mesh_back_uvs) returns, of an [object](crate::scene::Object) that exists.
    pub fn object_back_uvs(&self, object: u32) -> Result<(MeshUvs, Vec<bool>)> {
        let uvs = self.uvs_of(object, false)?;
        let own = self.atlas.scene.triangles_of(object).map(|t| self.has_both_sides(t));
        let own = try_collect(own, "the UVs of a mesh")?;
        Ok((uvs, own))
    }

    fn uvs_of(&self, object: u32, front: bool) -> Result<MeshUvs> {
        let triangles = self.atlas.scene.triangles_of(object);
        let mut uvs = try_with_capacity(triangles.len(), "the UVs of a mesh")?;
        let mut pages = try_with_capacity(triangles.len(), "the UVs of a mesh")?;
        for t in triangles {
            let (corners, page) = self.triangle_uvs(t, front);
            uvs.push(corners);
            pages.push(page);
        }
        Ok((uvs, pages))
    }

    /// Returns light map UVs and page of a side of a global triangle, as [`mesh_uvs`](Self::mesh_uvs) does.
    pub(crate) fn triangle_uvs(&self, triangle: u32, front: bool) -> ([[f32; 2]; 3], u32) {
        let (layout, chart) = (&self.atlas.map.layout, self.atlas.charts.chart_of(triangle));
        if chart == ChartId::NONE {
            return ([[0.0; 2]; 3], NONE);
        }
        let placement = layout.place_of(chart, front);
        let scale = 1.0 / layout.page_size as f32;
        // Rounding of placements may go beyond the page by some 1e-9.
        let uv = |c| layout.texel_coord(placement, c).map(|x| (x * scale).clamp(0.0, 1.0));
        (self.atlas.charts.corners(triangle).map(uv), layout[placement].page)
    }

    pub(super) fn light(&self) -> Result<&Light> {
        self.light.as_ref().ok_or_else(|| Error::InvalidState("the light map has not been baked yet".into()))
    }

    /// Returns one layer of one page, row-major from v = 0. The layers of light (combined, indirect, direct, radiance)
    /// need a bake (`InvalidState` before); the others can be read at any time. In the layers of light, texels around
    /// charts repeat the nearest covered texel, up to the padding.
    pub fn read(&self, page: u32, layer: Layer) -> Result<LayerData> {
        if page >= self.atlas.info.page_count {
            return invalid_argument!("page is {page}, the light map has {}", self.atlas.info.page_count);
        }
        let map = &self.atlas.map;
        match layer {
            Layer::Combined => {
                let light = self.light()?;
                self.page_of_light(page, |s| (light.direct[s.index()] + light.indirect[s.index()]).to_array())
            }
            Layer::Direct => {
                let light = self.light()?;
                self.page_of_light(page, |s| light.direct[s.index()].to_array())
            }
            Layer::Indirect => {
                let light = self.light()?;
                self.page_of_light(page, |s| light.indirect[s.index()].to_array())
            }
            Layer::Radiance => {
                let light = self.light()?;
                self.page_of_light(page, |s| self.radiance_at(light, s))
            }
            Layer::Error => {
                let light = self.light()?;
                let spread = light.spread()?;
                self.page_of_light(page, |s| spread[s.index()].error.to_array())
            }
            Layer::L0
            | Layer::L1X
            | Layer::L1Y
            | Layer::L1Z
            | Layer::RatioX
            | Layer::RatioY
            | Layer::RatioZ
            | Layer::Direction => {
                let light = self.light()?;
                if light.directional.is_empty() {
                    return Err(Error::InvalidState("the light map was baked without light by direction".into()));
                }
                self.page_of_light(page, |s| layer.of_directional(&light.directional[s.index()]).to_array())
            }
            Layer::Validity => {
                let padding = self.atlas.padding;
                Ok(LayerData::Scalar(self.page(page, 0.0, padding, |s| self.validity(s), |v| FILLED.min(v))?))
            }
            Layer::Position => {
                let position = |s| map.surface(&self.atlas.scene, s).0.to_array();
                Ok(LayerData::Rgb(self.page_of_samples(page, [0.0; 3], position)?))
            }
            Layer::Normal => {
                let backs = self.light.as_ref().map_or(&[][..], |l| &l.backs);
                let normal = |s: LightTexel| {
                    let n = map.surface(&self.atlas.scene, s).1;
                    if self.atlas.is_back(map, backs, s) { -n } else { n }.to_array()
                };
                Ok(LayerData::Rgb(self.page_of_samples(page, [0.0; 3], normal)?))
            }
            Layer::Chart => {
                let chart = |s| map.placement_of(&self.atlas.charts, s).index() as u32;
                Ok(LayerData::Integer(self.page(page, NONE, self.atlas.padding, chart, |v| v)?))
            }
            Layer::Triangle => {
                let triangle = |s: LightTexel| map[s].triangle;
                Ok(LayerData::Integer(self.page_of_samples(page, NONE, triangle)?))
            }
        }
    }

    /// Returns combined, direct or indirect light of one page from half of the passes of the last bake: the light, plus or
    /// minus half of what the halves differ by. (Of an odd number of passes, halves so made have a little of each other's
    /// noise.) `InvalidState` after a bake in one pass.
    pub fn read_half(&self, page: u32, layer: Layer, half: Half) -> Result<LayerData> {
        if page >= self.atlas.info.page_count {
            return invalid_argument!("page is {page}, the light map has {}", self.atlas.info.page_count);
        }
        let light = self.light()?;
        let spread = light.spread()?;
        let sign = if half == Half::First { 0.5 } else { -0.5 };
        let of = |mean: Vec3, difference: Vec3| (mean + difference * sign).max(Vec3::ZERO).to_array();
        let parts = |s: LightTexel| (light.direct[s.index()], light.indirect[s.index()], spread[s.index()].difference);
        match layer {
            Layer::Combined => self.page_of_light(page, |s| {
                let (direct, indirect, differences) = parts(s);
                of(direct + indirect, differences[0] + differences[1])
            }),
            Layer::Direct => self.page_of_light(page, |s| of(parts(s).0, parts(s).2[0])),
            Layer::Indirect => self.page_of_light(page, |s| of(parts(s).1, parts(s).2[1])),
            _ => invalid_argument!("layer is {layer:?}, of which there are no halves"),
        }
    }

    /// Returns the value of the validity layer for a texel.
    fn validity(&self, texel: LightTexel) -> f32 {
        // Before the first bake, all covered texels are valid.
        let Some(light) = &self.light else { return 1.0 };
        match light.state[texel.index()] {
            TexelState::Visible => 1.0,
            TexelState::Hidden => FILLED,
            TexelState::Unbaked => 0.0,
        }
    }

    /// Returns the outgoing radiance of a texel: reflected radiance from the radiance map, plus emitted.
    fn radiance_at(&self, light: &Light, texel: LightTexel) -> [f32; 3] {
        let t = self.atlas.map[texel];
        let back = self.atlas.is_back(&self.atlas.map, &light.backs, texel);
        let mut l = DirectLight::emitted(&self.atlas.scene, t.triangle, back);
        if light.radiance.values.is_empty() {
            let e = light.direct[texel.index()] + light.indirect[texel.index()];
            let a = &self.atlas;
            l += albedo(&a.areas(&a.map), texel) * e / std::f32::consts::PI;
        } else {
            let lookup = RadianceLookup::new(&self.atlas.charts, &self.atlas.radiance, &light.radiance);
            let hit = RawHit { t: 0.0, u: t.u, v: t.v, triangle: t.triangle, front: !back };
            l += lookup.reflected(&hit).unwrap_or_default();
        }
        l.to_array()
    }

    /// Composes a page from values of texels. `fill` turns the value of the nearest covered texel into that of a texel
    /// within
    /// `padding` of a chart.
    fn page<T: Copy + Default>(
        &self,
        page: u32,
        empty: T,
        padding: u32,
        value: impl Fn(LightTexel) -> T,
        fill: impl Fn(T) -> T,
    ) -> Result<Vec<T>> {
        let size = self.atlas.map.layout.page_size;
        let mut out = try_vec::<T>(size as usize * size as usize, "a page")?;
        out.fill(empty);
        let texels = &self.atlas.map.texels;
        let groups = texels.groups_of_page(page);
        texels.compose(
            groups,
            &PageArea::page(size),
            padding,
            &mut out,
            |s| value(LightTexel::new(s as usize)),
            fill,
        )?;
        Ok(out)
    }

    /// Composes a page of light, in which the padding repeats the nearest sample.
    fn page_of_light(&self, page: u32, value: impl Fn(LightTexel) -> [f32; 3]) -> Result<LayerData> {
        self.page_of_any(page, &value)
    }

    /// Does the work of [`page_of_light`](Self::page_of_light), compiled once for all layers.
    fn page_of_any(&self, page: u32, value: &dyn Fn(LightTexel) -> [f32; 3]) -> Result<LayerData> {
        Ok(LayerData::Rgb(self.page(page, [0.0; 3], self.atlas.padding, value, |v| v)?))
    }

    /// Composes a page of values that only covered texels have.
    fn page_of_samples<T: Copy + Default>(
        &self,
        page: u32,
        empty: T,
        value: impl Fn(LightTexel) -> T,
    ) -> Result<Vec<T>> {
        self.page(page, empty, 0, value, |v| v)
    }

    /// Whether the back of a global triangle has separate texels.
    pub(crate) fn has_both_sides(&self, triangle: u32) -> bool {
        self.atlas.map.layout.back(self.atlas.charts.chart_of(triangle)).is_some()
    }

    /// Whether the light map holds the light of a side of a global triangle. Before a bake, texels that both sides
    /// share hold the front.
    pub fn shows(&self, triangle: u32, front: bool) -> bool {
        let backs = self.light.as_ref().map_or(&[][..], |l| &l.backs);
        let back = backs.get(self.atlas.charts.chart_of(triangle).index()).is_some_and(|&b| b);
        front != back || self.has_both_sides(triangle)
    }

    /// Samples a layer of light as a shader would, at a point of one side of a global triangle (`u`, `v`: weights of
    /// vertices 1 and 2), bilinearly filtered within the chart. If both sides share texels, the result is the light of
    /// the side that is [shown](Self::shows). Zero before a bake, for layers that are not light, and for light by direction
    /// that no bake was asked for.
    pub fn sample(&self, layer: Layer, triangle: u32, front: bool, u: f32, v: f32) -> [f32; 3] {
        let Some(light) = &self.light else { return [0.0; 3] };
        let chart = self.atlas.charts.chart_of(triangle);
        if chart == ChartId::NONE {
            return [0.0; 3];
        }
        let value = |s: LightTexel| match layer {
            Layer::Combined => light.direct[s.index()] + light.indirect[s.index()],
            Layer::Direct => light.direct[s.index()],
            Layer::Indirect => light.indirect[s.index()],
            Layer::Radiance => self.radiance_at(light, s).into(),
            _ => light.directional.get(s.index()).map_or(Vec3::ZERO, |d| layer.of_directional(d)),
        };
        let mut sum = Vec3::ZERO;
        let placement = self.atlas.map.layout.place_of(chart, front);
        self.atlas.map.bilinear(placement, self.atlas.charts.local(triangle, u, v), |s, w| sum += w * value(s));
        sum.to_array()
    }
}
