//! Layouts: saving what of a light map takes long to find (`crate::lightmap::atlas::known`), so that another process makes
//! the same light map without unwrapping or looking for buried texels.
//!
//! A file holds records (`super::records`): `LAYT` with what the light map was made of and counts, `CHRT` (charts, in runs),
//! `TRIS` (their triangles with local coordinates; of instances that are unwrapped alike those of the first), `SEEN` (which
//! sides are seen), `PTCH` (texels that show other points, by map), `DONE`. Every number is checked before it is used.

use super::fingerprint::{self, compare};
use super::records::{self, MAGIC, Next, RUN, Tag, take_one};
use super::{damaged, unreadable};
use crate::base::error::{Error, Result};
use crate::base::files;
use crate::base::memory::{try_collect, try_push, try_with_capacity};
use crate::base::progress::Progress;
use crate::lightmap::atlas::alike;
use crate::lightmap::atlas::charts::{Charts, Given, MAX_TEXELS, UvReport};
use crate::lightmap::atlas::ids::ChartId;
use crate::lightmap::atlas::known::{Known, Patch};
use crate::lightmap::atlas::pieces::Piece;
use crate::lightmap::atlas::seen::{Seen, is_outdoors};
use crate::lightmap::atlas::sheets::Sheet;
use crate::lightmap::{Lightmap, LightmapDesc};
use crate::scene::Scene;
use bytemuck::{Pod, Zeroable};
use std::io::BufReader;
use std::path::Path;
use std::sync::Arc;

const HEAD: Tag = *b"LAYT";
const CHARTS: Tag = *b"CHRT";
const TRIANGLES: Tag = *b"TRIS";
const SEEN: Tag = *b"SEEN";
const PATCHES: Tag = *b"PTCH";
const DONE: Tag = *b"DONE";

/// Maximum extent of a chart, far more than one of valid triangles can have.
const MAX_LENGTH: f32 = 1e30;

/// Name of the buffers in error messages.
const LAYOUT: &str = "the layout of a light map";

/// What a layout depends on. Part of the file format.
#[derive(Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Origin {
    version: [u8; 16],
    /// Whether the ISA fuses multiplications and additions.
    is_fused: u32,
    /// Whether a sun or a sky shines.
    is_outdoors: u32,
    geometry: u32,
    uvs: u32,
    materials: u32,
    texels_per_unit: f32,
    page_size: u32,
    padding: u32,
    gather_divisor: u32,
    radiance_divisor: u32,
    both_sides: u32,
    /// Checksum of the regions from which the scene is looked at.
    seen_from: u32,
}

/// The content of the first record.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Head {
    origin: Origin,
    charts: u64,
    triangles: u64,
    seen: u64,
    patches: [u64; 3],
    places: u64,
    rays: u64,
    sight_rays: u64,
    out_of_range: u64,
    degenerate: u64,
    overlapping: u64,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct SavedChart {
    triangles: u32,
    is_given: u32,
    page: u32,
    offset: [f32; 2],
    scale: [f32; 2],
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct SavedTriangle {
    triangle: u32,
    corners: [[f32; 2]; 3],
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct SavedSides {
    counts: [u32; 2],
    hidden: [u32; 2],
    /// Whether the chart cannot be seen from where the scene is looked at.
    unseen: u32,
}

impl Origin {
    fn new(scene: &Scene, desc: &LightmapDesc, is_outdoors: bool) -> Origin {
        // All fields are named, since parameters that are added must be compared here, too.
        let LightmapDesc {
            texels_per_unit,
            page_size,
            padding,
            gather_divisor,
            radiance_divisor,
            both_sides,
            ref seen_from,
        } = *desc;
        Origin {
            version: fingerprint::version(),
            is_fused: scene.device().isa().is_fused().into(),
            is_outdoors: is_outdoors.into(),
            geometry: fingerprint::geometry(scene),
            uvs: uvs(scene),
            materials: fingerprint::materials(scene),
            texels_per_unit,
            page_size,
            padding,
            gather_divisor,
            radiance_divisor,
            both_sides: both_sides.into(),
            seen_from: crc32fast::hash(bytemuck::cast_slice(seen_from)),
        }
    }

    /// Names the differences between this origin, from a file, and the one that is needed.
    fn difference(&self, needed: &Origin) -> Option<String> {
        let mut all = Vec::new();
        let sums = [
            ("the library's version", self.version == needed.version),
            ("the instruction set", self.is_fused == needed.is_fused),
            ("whether a sun or a sky shines", self.is_outdoors == needed.is_outdoors),
            ("the scene's geometry", self.geometry == needed.geometry),
            ("the light map UVs", self.uvs == needed.uvs),
            ("the scene's materials", self.materials == needed.materials),
            ("from where it is seen", self.seen_from == needed.seen_from),
        ];
        all.extend(sums.iter().filter(|s| !s.1).map(|s| s.0.to_owned()));
        compare(&mut all, "texels_per_unit", self.texels_per_unit, needed.texels_per_unit);
        compare(&mut all, "page_size", self.page_size, needed.page_size);
        compare(&mut all, "padding", self.padding, needed.padding);
        compare(&mut all, "gather_divisor", self.gather_divisor, needed.gather_divisor);
        compare(&mut all, "radiance_divisor", self.radiance_divisor, needed.radiance_divisor);
        compare(&mut all, "both_sides", self.both_sides, needed.both_sides);
        (!all.is_empty()).then(|| all.join(", "))
    }
}

/// Computes the checksum of the light map UVs of all meshes.
fn uvs(scene: &Scene) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    for mesh in scene.meshes() {
        let lightmap = mesh.lightmap.as_ref();
        sum.update(&[lightmap.is_some().into()]);
        if let Some(lightmap) = lightmap {
            sum.update(bytemuck::cast_slice(&lightmap.uvs));
            sum.update(bytemuck::cast_slice(&lightmap.pages));
        }
    }
    sum.finalize()
}

impl Lightmap {
    /// Writes charts and texels to a file, which is replaced as a whole, for [`load_layout`](Self::load_layout).
    pub fn save_layout(&self, path: &Path, progress: &Progress) -> Result<()> {
        let device = self.atlas.scene.device();
        device.run(progress, || self.write_layout(path, progress))?.finish()
    }

    fn write_layout(&self, path: &Path, progress: &Progress) -> Result<files::Replacement> {
        let (charts, seen, info) = (&self.atlas.charts, &self.atlas.seen, &self.atlas.info);
        let patches = self.patches(progress)?;
        let head = Head {
            origin: Origin::new(&self.atlas.scene, &self.atlas.desc, self.atlas.is_outdoors),
            charts: charts.sheets().map(|(_, charts)| charts.len() as u64).sum(),
            triangles: charts.sheets().map(|(sheet, _)| sheet.triangles.len() as u64).sum(),
            seen: seen.counts.len() as u64,
            patches: patches.each_ref().map(|p| p.len() as u64),
            places: seen.places,
            rays: seen.rays,
            sight_rays: info.sight_rays,
            out_of_range: info.uvs.out_of_range,
            degenerate: info.uvs.degenerate,
            overlapping: info.uvs.overlapping,
        };
        let stage = progress.stage("saving", 0.5, 1.0, head.items());
        files::prepare(path, |file| {
            let mut out = MAGIC.to_vec();
            let mut write = |out: &mut Vec<u8>, items: usize| {
                file.append(out, |_| stage.advance(0))?;
                out.clear();
                stage.advance(items as u64)
            };
            records::append(&mut out, HEAD, &[bytemuck::bytes_of(&head)])?;
            for run in charts.sheets().flat_map(|(_, charts)| charts.chunks(RUN)) {
                let saved = run.iter().map(|c| {
                    let given = c.given.unwrap_or(Given { page: 0, offset: [0.0; 2], scale: [0.0; 2] });
                    let Given { page, offset, scale } = given;
                    SavedChart {
                        triangles: c.triangles.len() as u32,
                        is_given: c.given.is_some().into(),
                        page,
                        offset,
                        scale,
                    }
                });
                records::append(&mut out, CHARTS, &[bytemuck::cast_slice(&try_collect(saved, LAYOUT)?)])?;
                write(&mut out, run.len())?;
            }
            let runs = charts.sheets().flat_map(|(sheet, _)| sheet.triangles.chunks(RUN).map(move |run| (sheet, run)));
            for (sheet, run) in runs {
                let saved = run
                    .iter()
                    .map(|&t| SavedTriangle { triangle: sheet.first_triangle + t, corners: sheet.corners[t as usize] });
                records::append(&mut out, TRIANGLES, &[bytemuck::cast_slice(&try_collect(saved, LAYOUT)?)])?;
                write(&mut out, run.len())?;
            }
            for (run, (counts, hidden)) in seen.counts.chunks(RUN).zip(seen.hidden.chunks(RUN)).enumerate() {
                let unseen = |i: usize| seen.unseen.get(run * RUN + i).is_some_and(|&unseen| unseen).into();
                let saved = counts.iter().zip(hidden).enumerate().map(|(i, (&counts, hidden))| SavedSides {
                    counts,
                    hidden: hidden.map(u32::from),
                    unseen: unseen(i),
                });
                records::append(&mut out, SEEN, &[bytemuck::cast_slice(&try_collect(saved, LAYOUT)?)])?;
                write(&mut out, counts.len())?;
            }
            for (number, of_map) in (0u32..).zip(&patches) {
                for run in of_map.chunks(RUN) {
                    records::append(&mut out, PATCHES, &[bytemuck::bytes_of(&number), bytemuck::cast_slice(run)])?;
                    write(&mut out, run.len())?;
                }
            }
            records::append(&mut out, DONE, &[])?;
            write(&mut out, 0)
        })
    }

    /// Creates the light map that [`save_layout`](Self::save_layout) wrote, of the same scene and description: it has the
    /// bits of one that is created anew.
    pub fn load_layout(scene: &Arc<Scene>, desc: &LightmapDesc, path: &Path, progress: &Progress) -> Result<Lightmap> {
        desc.validate()?;
        scene.device().run(progress, || {
            let known = read(scene, desc, path, progress)?;
            Self::lay_out(scene, desc, Some(known), None, progress)
        })
    }
}

impl Head {
    /// Number of items in the file.
    fn items(&self) -> u64 {
        [self.charts, self.triangles, self.seen].iter().chain(&self.patches).fold(0, |a, &b| a.saturating_add(b))
    }
}

/// What a file holds.
#[derive(Default)]
struct Content {
    charts: Vec<SavedChart>,
    triangles: Vec<SavedTriangle>,
    seen: Vec<SavedSides>,
    patches: [Vec<Patch>; 3],
}

fn read(scene: &Scene, desc: &LightmapDesc, path: &Path, progress: &Progress) -> Result<Known> {
    let fail = |e| unreadable(path, e);
    let file = files::open(path).map_err(fail)?;
    let size = file.metadata().map_err(fail)?.len();
    let file = BufReader::with_capacity(1 << 16, file);
    let (mut records, head): (_, Head) = records::begin(file, size, HEAD, path, "layout of a light map")?;
    if let Some(differences) = head.origin.difference(&Origin::new(scene, desc, is_outdoors(scene))) {
        let name = path.display();
        return Err(Error::InvalidArgument(format!(
            "{name} is the layout of another light map; it differs in {differences}"
        )));
    }
    let triangles = u64::from(scene.triangle_count());
    let fits = head.charts <= head.triangles && head.triangles <= triangles && head.seen <= MAX_TEXELS;
    if !fits || head.patches.iter().any(|&p| p > MAX_TEXELS) {
        return Err(damaged(path));
    }
    let bytes = head.triangles as usize * (2 * size_of::<SavedTriangle>() + Charts::BYTES_PER_TRIANGLE);
    let _memory = scene.device().memory().reserve(bytes, LAYOUT)?;
    let stage = progress.stage("loading", 0.0, 0.4, head.items());
    let mut content = Content::default();
    loop {
        let Next::Record(tag, bytes) = records.next().map_err(fail)? else { return Err(damaged(path)) };
        let items = match tag {
            CHARTS => append(&bytes, head.charts, &mut content.charts)?,
            TRIANGLES => append(&bytes, head.triangles, &mut content.triangles)?,
            SEEN => append(&bytes, head.seen, &mut content.seen)?,
            PATCHES => append_patches(&bytes, &head, &mut content.patches)?,
            DONE => break,
            _ => None,
        };
        stage.advance(items.ok_or_else(|| damaged(path))? as u64)?;
    }
    let is_whole = content.charts.len() as u64 == head.charts
        && content.triangles.len() as u64 == head.triangles
        && content.seen.len() as u64 == head.seen
        && (0..3).all(|i| content.patches[i].len() as u64 == head.patches[i]);
    if !is_whole {
        return Err(damaged(path));
    }
    known(scene, desc, &head, content, path, progress)
}

/// Appends the items of a record; returns their number, `None` if there are more than `all` then.
fn append<T: Pod>(content: &[u8], all: u64, items: &mut Vec<T>) -> Result<Option<usize>> {
    let count = content.len() / size_of::<T>();
    if !content.len().is_multiple_of(size_of::<T>()) || count > RUN || (items.len() + count) as u64 > all {
        return Ok(None);
    }
    for item in content.chunks_exact(size_of::<T>()) {
        try_push(items, bytemuck::pod_read_unaligned(item), LAYOUT)?;
    }
    Ok(Some(count))
}

fn append_patches(mut content: &[u8], head: &Head, patches: &mut [Vec<Patch>; 3]) -> Result<Option<usize>> {
    let number = take_one::<u32>(&mut content).map(|n| n as usize);
    let Some(number) = number.filter(|&n| n < patches.len()) else { return Ok(None) };
    append(content, head.patches[number], &mut patches[number])
}

/// Makes charts of what a file holds, if they can be charts of the scene.
fn known(
    scene: &Scene,
    desc: &LightmapDesc,
    head: &Head,
    content: Content,
    path: &Path,
    progress: &Progress,
) -> Result<Known> {
    let pages = MAX_TEXELS / u64::from(desc.page_size).pow(2);
    let mut pieces: Vec<Piece> = try_with_capacity(content.charts.len(), LAYOUT)?;
    let stage = progress.stage("charts", 0.4, 0.5, u64::from(scene.triangle_count()));
    let sources = alike::sources(scene, &stage)?;
    // No local coordinates are longer than the surface is, wherever it stands.
    let limit = sources.iter().fold(1.0f32, |m, s| m.max(s.factor)).recip() * MAX_LENGTH;
    let (mut rest, mut last_page, mut object) = (&content.triangles[..], Some(0), 0);
    for chart in &content.charts {
        stage.check()?;
        let of_chart = rest.split_at_checked(chart.triangles as usize).filter(|s| !s.0.is_empty());
        let (triangles, others) = of_chart.ok_or_else(|| damaged(path))?;
        rest = others;
        // Charts of meshes come first, then those of instances that are their own sources.
        let is_of_scene = |t: &SavedTriangle| {
            t.triangle < scene.triangle_count()
                && scene.is_valid(t.triangle)
                && t.corners.iter().flatten().all(|c| c.abs() <= limit)
        };
        if !triangles.iter().all(is_of_scene) || !triangles.is_sorted_by(|a, b| a.triangle < b.triangle) {
            return Err(damaged(path));
        }
        let meshes = scene.meshes().len() as u32;
        let [first, last] = [&triangles[0], &triangles[triangles.len() - 1]].map(|t| {
            let object = scene.locate(t.triangle).0;
            object.checked_sub(meshes).map_or(0, |instance| instance + 1)
        });
        let has_sheet = first.checked_sub(1).is_none_or(|instance| sources[instance as usize].instance == instance);
        if first != last || first < object || !has_sheet {
            return Err(damaged(path));
        }
        object = first;
        let given =
            (chart.is_given != 0).then_some(Given { page: chart.page, offset: chart.offset, scale: chart.scale });
        // Given charts come first, ordered by page, and lie on their pages.
        let is_possible = given.is_none_or(|given| {
            let uv = |c: [f32; 2], i: usize| given.offset[i] + given.scale[i] * c[i];
            first == 0
                && last_page.is_some_and(|last| last <= given.page)
                && u64::from(given.page) < pages
                && (0..2).all(|i| triangles.iter().flat_map(|t| t.corners).all(|c| (-1.0..=2.0).contains(&uv(c, i))))
        });
        if !is_possible {
            return Err(damaged(path));
        }
        last_page = given.map(|g| g.page);
        pieces.push(Piece {
            triangles: try_collect(triangles.iter().map(|t| t.triangle), LAYOUT)?.into(),
            corners: try_collect(triangles.iter().map(|t| t.corners), LAYOUT)?.into(),
            given,
        });
    }
    let given_charts = pieces.iter().take_while(|p| p.given.is_some()).count() as u32;
    let charts = Charts::assemble(scene, pieces, &sources, &stage)?;
    let has_chart = |sheet: &Sheet| sheet.of_triangles.iter().filter(|&&chart| chart != ChartId::NONE).count();
    if charts.sheets().any(|(sheet, _)| sheet.triangles.len() != has_chart(sheet)) {
        return Err(damaged(path)); // A triangle is in two charts.
    }
    let uvs = UvReport {
        given_charts,
        unwrapped_charts: charts.charts.len() as u32 - given_charts,
        out_of_range: head.out_of_range,
        degenerate: head.degenerate,
        overlapping: head.overlapping,
        ..UvReport::default()
    };
    let looks = !desc.seen_from.is_empty();
    let sides = if looks || charts.charts.iter().any(|c| c.two_sided) { charts.charts.len() } else { 0 };
    if !rest.is_empty() || content.seen.len() != sides {
        return Err(damaged(path));
    }
    let seen = Seen {
        counts: try_collect(content.seen.iter().map(|s| s.counts), LAYOUT)?,
        hidden: try_collect(content.seen.iter().map(|s| s.hidden.map(|h| h != 0)), LAYOUT)?,
        unseen: match looks {
            true => try_collect(content.seen.iter().map(|s| s.unseen != 0), LAYOUT)?,
            false => Vec::new(),
        },
        places: head.places,
        rays: head.rays,
    };
    let (patches, name) = (content.patches, path.display().to_string());
    Ok(Known { charts, uvs, seen, sight_rays: head.sight_rays, patches, name })
}
