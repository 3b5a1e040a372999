//! Materials and meshes
//!
//! Added to a scene before its commit; vertices can move after it. A refused addition changes
//! nothing.
//!
//! Input arrays are read inside the call only. Strides are in bytes, 0 means packed; neither
//! alignment nor bytes behind the last element are needed.

use super::args::{
    OutStruct, SizedStruct, check_flags, init, read_optional, read_strided, read_struct, sized_struct, write_optional,
};
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::{hold, object};
use super::scene::bk_scene;
use crate::error::{Result, invalid_argument};
use crate::scene::{LightmapUvs, Material, Mesh, MeshMaterials, NONE, SceneData};
use glam::{Vec2, Vec3};

const _: () = assert!(BK_NONE == NONE);

/// Flag: the back side reflects and emits like the front. The back of a one-sided material absorbs
/// what meets it and is not transmitted.
pub const BK_MATERIAL_TWO_SIDED: u32 = 1;

/// A diffuse material.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_material_desc {
    /// Size of this structure in bytes, set by bk_material_desc_init.
    pub struct_size: u32,
    /// BK_MATERIAL flags. Default: 0.
    pub flags: u32,
    /// Diffuse reflectance per channel, in [0, 1); with albedo_texture: its factor, in [0, 1]. Default: 0.5.
    pub albedo: [f32; 3],
    /// Emitted radiance per channel in W/(m2 sr), >= 0. Default: 0.
    pub emission: [f32; 3],
    /// Number of the texture that is multiplied with albedo, the product being limited to 0.98; BK_NONE: none.
    /// Where a mesh has no uvs, albedo alone counts. Default: BK_NONE.
    pub albedo_texture: u32,
    /// Points where the texture's alpha, interpolated and from 0 to 1, is less than this are holes, which rays and
    /// photons do not meet, from whichever side. In [0, 1]; not for materials that emit. Holes cost rays that
    /// meet them a second search. Default: 0, no holes.
    pub alpha_cutoff: f32,
    /// Fraction of light per channel that passes straight through, from either side, as through a pane of
    /// stained glass; at most 1 together with albedo. It is not textured. Light of lamps that comes through
    /// is direct light. bk_intersect, bk_occluded and their like meet the surface all the same. Default: 0.
    pub transmission: [f32; 3],
}

sized_struct!(bk_material_desc, defaults: material_desc(&Material::default()));

fn material_desc(m: &Material) -> bk_material_desc {
    bk_material_desc {
        struct_size: size_of::<bk_material_desc>() as u32,
        flags: if m.two_sided { BK_MATERIAL_TWO_SIDED } else { 0 },
        albedo: m.albedo,
        emission: m.emission,
        albedo_texture: m.albedo_texture,
        alpha_cutoff: m.alpha_cutoff,
        transmission: m.transmission,
    }
}

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_material_desc_init(desc: *mut bk_material_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a material. The texture that it names must have been added before.
///
/// out_id: receives its number, for meshes; NULL if not wanted. Numbers count up from 0 in the
/// order of addition.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_add_material(
    scene: *mut bk_scene,
    desc: *const bk_material_desc,
    out_id: *mut u32,
) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: the caller's structure, or NULL.
        let desc = unsafe { read_struct(desc, "desc") }?;
        check_flags(desc.flags, BK_MATERIAL_TWO_SIDED, "flags")?;
        let material = Material {
            albedo: desc.albedo,
            emission: desc.emission,
            two_sided: desc.flags & BK_MATERIAL_TWO_SIDED != 0,
            albedo_texture: desc.albedo_texture,
            alpha_cutoff: desc.alpha_cutoff,
            transmission: desc.transmission,
        };
        let id = scene.describe("materials can be added", |d| d.data.add_material(material))?;
        // SAFETY: out_id is the caller's, or NULL.
        unsafe { write_optional(out_id, id) }
    })
}

/// The number of materials, committed or not; 0 on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_material_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.materials().len(), |s| s.materials().len()))
}

/// Fetches a material, committed or not.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_material(
    scene: *const bk_scene,
    id: u32,
    out: *mut bk_material_desc,
) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        out.write(material_desc(&scene.either(|d| find(d.materials(), id), |s| find(s.materials(), id))?));
        Ok(())
    })
}

fn find(materials: &[Material], id: u32) -> Result<Material> {
    match materials.get(id as usize) {
        Some(material) => Ok(*material),
        None => invalid_argument!("material {id} does not exist, the scene has {}", materials.len()),
    }
}

/// Flag: refuse degenerate triangles and vertices that are not finite, naming the first, rather
/// than skip and count them.
pub const BK_MESH_STRICT: u32 = 1;

/// An indexed triangle mesh. The arrays are copied.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_mesh_desc {
    /// Size of this structure in bytes, set by bk_mesh_desc_init.
    pub struct_size: u32,
    /// BK_MESH flags. Default: 0.
    pub flags: u32,
    /// vertex_count positions of three floats.
    pub positions: *const f32,
    /// Bytes from one position to the next, at least 12; 0: packed.
    pub position_stride: usize,
    /// Number of vertices.
    pub vertex_count: usize,
    /// Three vertex numbers per triangle, packed, each less than vertex_count.
    pub indices: *const u32,
    /// Number of triangles; at most 2^28 in a scene.
    pub triangle_count: usize,
    /// Optional: vertex_count shading normals of three floats.
    pub normals: *const f32,
    /// Bytes from one normal to the next, at least 12; 0: packed.
    pub normal_stride: usize,
    /// Optional: vertex_count texture coordinates of two floats, which place the textures of materials.
    pub uvs: *const f32,
    /// Bytes from one texture coordinate to the next, at least 8; 0: packed.
    pub uv_stride: usize,
    /// Optional: vertex_count light map coordinates of two floats, in [0, 1] on a page, no two
    /// points of a page's triangles at the same place. Without them the mesh is unwrapped.
    pub lightmap_uvs: *const f32,
    /// Bytes from one light map coordinate to the next, at least 8; 0: packed.
    pub lightmap_uv_stride: usize,
    /// Optional, with lightmap_uvs only: light map page per triangle, packed. NULL: all on page 0.
    pub lightmap_page: *const u32,
    /// Optional: material number per triangle, packed. NULL: all have `material`.
    pub triangle_materials: *const u32,
    /// Material number of all triangles if triangle_materials is NULL. Default: 0.
    pub material: u32,
}

sized_struct!(bk_mesh_desc, defaults: bk_mesh_desc {
    struct_size: size_of::<bk_mesh_desc>() as u32,
    flags: 0,
    positions: std::ptr::null(),
    position_stride: 0,
    vertex_count: 0,
    indices: std::ptr::null(),
    triangle_count: 0,
    normals: std::ptr::null(),
    normal_stride: 0,
    uvs: std::ptr::null(),
    uv_stride: 0,
    lightmap_uvs: std::ptr::null(),
    lightmap_uv_stride: 0,
    lightmap_page: std::ptr::null(),
    triangle_materials: std::ptr::null(),
    material: 0,
});

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_mesh_desc_init(desc: *mut bk_mesh_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a mesh. The materials that it names must have been added before.
///
/// out_id: receives its number, as hits report it; NULL if not wanted. Numbers count up from 0 in
/// the order of addition.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT, naming triangle and vertex, if an index or a material is
/// out of range or BK_MESH_STRICT finds something.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_add_mesh(
    scene: *mut bk_scene,
    desc: *const bk_mesh_desc,
    out_id: *mut u32,
) -> bk_result {
    // SAFETY: desc, the arrays in it and out_id are the caller's, or NULL.
    call(|| unsafe {
        // The memory callback may release it.
        let scene = hold(scene, "scene")?;
        let desc = read_struct(desc, "desc")?;
        let id = scene.describe_large("meshes can be added", bytes(&desc), || read_mesh(&desc), SceneData::add_mesh)?;
        write_optional(out_id, id)
    })
}

/// What a copy of a mesh takes.
fn bytes(d: &bk_mesh_desc) -> usize {
    let if_given = |given: bool, bytes: usize| if given { bytes } else { 0 };
    let per_vertex = size_of::<Vec3>()
        + if_given(!d.normals.is_null(), size_of::<Vec3>())
        + if_given(!d.uvs.is_null(), size_of::<Vec2>())
        + if_given(!d.lightmap_uvs.is_null(), size_of::<Vec2>());
    let per_triangle = size_of::<[u32; 3]>()
        + if_given(!d.lightmap_page.is_null(), size_of::<u32>())
        + if_given(!d.triangle_materials.is_null(), size_of::<u32>());
    // Impossible numbers are refused by name where the arrays are read.
    let all = d.vertex_count.saturating_mul(per_vertex).saturating_add(d.triangle_count.saturating_mul(per_triangle));
    if all > isize::MAX as usize { 0 } else { all }
}

/// # Safety
/// The arrays hold what the description says.
unsafe fn read_mesh(d: &bk_mesh_desc) -> Result<Mesh> {
    check_flags(d.flags, BK_MESH_STRICT, "flags")?;
    let (vertices, triangles) = (d.vertex_count, d.triangle_count);
    if d.lightmap_uvs.is_null() && !d.lightmap_page.is_null() {
        return invalid_argument!("lightmap_page is given, but lightmap_uvs is NULL");
    }
    // SAFETY: by contract; optional arrays may be NULL.
    unsafe {
        Ok(Mesh {
            positions: read_strided::<Vec3>(d.positions, d.position_stride, vertices, "positions")?,
            indices: read_strided::<[u32; 3]>(d.indices, 0, triangles, "indices")?,
            normals: read_optional::<Vec3>(d.normals, d.normal_stride, vertices, "normals")?,
            uvs: read_optional::<Vec2>(d.uvs, d.uv_stride, vertices, "uvs")?,
            lightmap: if d.lightmap_uvs.is_null() {
                None
            } else {
                Some(LightmapUvs {
                    uvs: read_strided::<Vec2>(d.lightmap_uvs, d.lightmap_uv_stride, vertices, "lightmap_uvs")?,
                    pages: read_optional::<u32>(d.lightmap_page, 0, triangles, "lightmap_page")?,
                })
            },
            materials: if d.triangle_materials.is_null() {
                MeshMaterials::One(d.material)
            } else {
                MeshMaterials::PerTriangle(read_strided(d.triangle_materials, 0, triangles, "triangle_materials")?)
            },
            strict: d.flags & BK_MESH_STRICT != 0,
        })
    }
}

/// Sets new positions for all vertices of a mesh of a committed scene, to be put in force by
/// bk_scene_refit; until then nothing changes. What was set for the mesh since the last refit is
/// replaced.
///
/// mesh: number of the mesh. positions: vertex_count positions of three floats, copied. vertex_count:
/// as when the mesh was added. stride: bytes from one position to the next, at least 12; 0: packed.
/// Shading normals, texture and light map coordinates stay as they were given.
///
/// Positions that are not finite are taken, and their triangles are not hit after the refit, unless the
/// mesh has BK_MESH_STRICT. Fails with BK_ERROR_INVALID_STATE if the scene is not committed or another
/// thread is changing it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_mesh_set_positions(
    scene: *mut bk_scene,
    mesh: u32,
    positions: *const f32,
    vertex_count: usize,
    stride: usize,
) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // The number before the array: a wrong one must not be read by.
        let (count, meshes) = {
            let committed = scene.committed()?;
            (committed.meshes().get(mesh as usize).map(|m| m.positions.len()), committed.meshes().len())
        };
        match count {
            None => return invalid_argument!("mesh {mesh} does not exist, the scene has {meshes}"),
            Some(count) if count != vertex_count => {
                return invalid_argument!("vertex_count is {vertex_count}, the mesh has {count} vertices");
            }
            Some(_) => {}
        }
        // SAFETY: positions are the caller's, or NULL.
        scene.set_positions(mesh, || unsafe { read_strided(positions, stride, vertex_count, "positions") })
    })
}

/// The number of meshes, committed or not; 0 on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_mesh_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.meshes().len(), |s| s.meshes().len()))
}

/// The triangles of a mesh.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_mesh_view {
    /// Size of this structure in bytes, set by bk_mesh_view_init.
    pub struct_size: u32,
    /// Material number of all triangles if triangle_materials is NULL, else BK_NONE.
    pub material: u32,
    /// vertex_count positions of three floats, packed.
    pub positions: *const f32,
    /// Number of vertices.
    pub vertex_count: usize,
    /// Three vertex numbers per triangle, packed.
    pub indices: *const u32,
    /// Number of triangles, degenerate ones included.
    pub triangle_count: usize,
    /// vertex_count shading normals of three floats, packed; NULL if the mesh has none.
    pub normals: *const f32,
    /// vertex_count texture coordinates of two floats, packed; NULL if the mesh has none.
    pub uvs: *const f32,
    /// vertex_count light map coordinates of two floats, packed, as the caller gave them; NULL if the mesh has none.
    pub lightmap_uvs: *const f32,
    /// Light map page per triangle, packed, as the caller gave them; NULL if all are on page 0.
    pub lightmap_page: *const u32,
    /// Material number per triangle, packed; NULL if all have `material`.
    pub triangle_materials: *const u32,
}

sized_struct!(bk_mesh_view, defaults: bk_mesh_view {
    struct_size: size_of::<bk_mesh_view>() as u32,
    material: BK_NONE,
    positions: std::ptr::null(),
    vertex_count: 0,
    indices: std::ptr::null(),
    triangle_count: 0,
    normals: std::ptr::null(),
    uvs: std::ptr::null(),
    lightmap_uvs: std::ptr::null(),
    lightmap_page: std::ptr::null(),
    triangle_materials: std::ptr::null(),
});

/// Sets struct_size and clears the rest.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_mesh_view_init(view: *mut bk_mesh_view) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(view) }
}

/// Shows the triangles of a mesh of a committed scene, without a copy.
///
/// out: receives pointers that are valid while the scene lives, until the next bk_scene_refit.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_mesh(scene: *const bk_scene, mesh: u32, out: *mut bk_mesh_view) -> bk_result {
    call(|| {
        let scene = object!(scene);
        let committed = scene.committed()?;
        let meshes = committed.meshes();
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        let Some(m) = meshes.get(mesh as usize) else {
            return invalid_argument!("mesh {mesh} does not exist, the scene has {}", meshes.len());
        };
        let (material, triangle_materials) = match &m.materials {
            MeshMaterials::One(material) => (*material, std::ptr::null()),
            MeshMaterials::PerTriangle(materials) => (BK_NONE, pointer(materials)),
        };
        let lightmap = m.lightmap.as_ref();
        out.write(bk_mesh_view {
            material,
            triangle_materials,
            normals: pointer(&m.normals).cast(),
            uvs: pointer(&m.uvs).cast(),
            lightmap_uvs: lightmap.map_or(std::ptr::null(), |l| pointer(&l.uvs).cast()),
            lightmap_page: lightmap.map_or(std::ptr::null(), |l| pointer(&l.pages)),
            positions: m.positions.as_ptr().cast(),
            vertex_count: m.positions.len(),
            indices: m.indices.as_ptr().cast(),
            triangle_count: m.indices.len(),
            ..SizedStruct::defaults()
        });
        Ok(())
    })
}

/// The array, or NULL if it is empty: then the mesh has none.
fn pointer<T>(array: &[T]) -> *const T {
    if array.is_empty() { std::ptr::null() } else { array.as_ptr() }
}
