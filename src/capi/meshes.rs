//! Materials and meshes
//!
//! Materials and meshes are added to a scene before its commit; vertices can move after it.
//!
//! Input arrays need neither alignment nor bytes behind the last element. Strides are in bytes; 0
//! means packed.
//!
//! Thread safety: as for scenes; the functions that read are safe from any thread, but before the
//! commit fail with BK_ERROR_INVALID_STATE while another thread is changing the scene.
//!
//! Cost: adding and moving copy the arrays; reading copies nothing but the structure and takes less
//! than a microsecond.

use super::args::{
    OutStruct, SizedStruct, check_flags, init, read_optional, read_strided, read_struct, sized_struct, write_optional,
};
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::{hold, object};
use super::scene::bk_scene;
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::Reservation;
use crate::base::progress::Progress;
use crate::scene::{LightmapUvs, Material, Mesh, MeshMaterials, NONE, SceneData};
use glam::{Vec2, Vec3};

const _: () = assert!(BK_NONE == NONE);

/// Flag of bk_material_desc: the back reflects and emits like the front. The back of a one-sided
/// material absorbs light and transmits none.
pub const BK_MATERIAL_TWO_SIDED: u32 = 1;

/// A diffuse material.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_material_desc {
    /// Size of this structure in bytes, set by bk_material_desc_init.
    pub struct_size: u32,
    /// BK_MATERIAL flags. Default: 0.
    pub flags: u32,
    /// Diffuse reflectance per channel, a fraction in [0, 1); with `albedo_texture` a factor in [0,
    /// 1]. Default: 0.5.
    pub albedo: [f32; 3],
    /// Emitted radiance per channel in W/(m2 sr), >= 0. Default: 0.
    pub emission: [f32; 3],
    /// Number of the texture that is multiplied with `albedo`, or BK_NONE; the product is clamped
    /// to 0.98. Meshes without `uvs` use `albedo` alone. Default: BK_NONE.
    pub albedo_texture: u32,
    /// Threshold of alpha tests, a fraction in [0, 1]: points where the interpolated alpha of the
    /// texture is smaller are cut out, and rays and photons pass them from either side. Must be 0
    /// for materials that emit. Rays that hit a cut-out are traced a second time. Default: 0,
    /// nothing is cut out.
    pub alpha_cutoff: f32,
    /// Fraction of light per channel that passes straight through, from either side, as through
    /// stained glass; its sum with `albedo` is at most 1. It is not textured. Transmitted light of
    /// lights counts as direct light. bk_intersect, bk_occluded and the other ray queries hit the
    /// surface nevertheless. Default: 0.
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

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_material_desc_init(desc: *mut bk_material_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a material. The texture that it names must have been added before.
///
/// @param scene  scene that is not committed
/// @param desc  copied
/// @param out_id  receives the number of the material, for meshes; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range or names no texture
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
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

/// Returns the number of materials of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of materials; 0 on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_material_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.materials().len(), |s| s.materials().len()))
}

/// Gets a material of a scene, committed or not.
///
/// @param scene  any scene
/// @param id  number of the material
/// @param out  receives a copy of the material
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such material
/// @retval BK_ERROR_INVALID_STATE  another thread is changing the scene
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

/// Flag of bk_mesh_desc: degenerate triangles and vertices that are not finite are errors, instead
/// of being skipped and counted.
pub const BK_MESH_STRICT: u32 = 1;

/// An indexed triangle mesh.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_mesh_desc {
    /// Size of this structure in bytes, set by bk_mesh_desc_init.
    pub struct_size: u32,
    /// BK_MESH flags. Default: 0.
    pub flags: u32,
    /// Material number of all triangles if `triangle_materials` is NULL. Default: 0.
    pub material: u32,
    /// `vertex_count` positions of three floats, in scene units. Default: NULL.
    pub positions: *const f32,
    /// Distance between positions in bytes, at least 12; 0: packed. Default: 0.
    pub position_stride: usize,
    /// Number of vertices. Default: 0.
    pub vertex_count: usize,
    /// Three vertex numbers per triangle, packed, each less than `vertex_count`. Default: NULL.
    pub indices: *const u32,
    /// Number of triangles; at most 2^28. All meshes without instances together have at most as many
    /// when the scene is committed; those of all instances are at most 2^32 - 2. Default: 0.
    pub triangle_count: usize,
    /// `vertex_count` shading normals of three floats, unit vectors; may be NULL. Default: NULL,
    /// geometric normals.
    pub normals: *const f32,
    /// Distance between normals in bytes, at least 12; 0: packed. Default: 0.
    pub normal_stride: usize,
    /// `vertex_count` texture coordinates of two floats, 1 per width or height of an image; may be
    /// NULL. Default: NULL.
    pub uvs: *const f32,
    /// Distance between texture coordinates in bytes, at least 8; 0: packed. Default: 0.
    pub uv_stride: usize,
    /// `vertex_count` light map coordinates of two floats in [0, 1], 1 per width or height of a
    /// page; triangles of a page must not overlap. May be NULL: the mesh is unwrapped. Default:
    /// NULL.
    pub lightmap_uvs: *const f32,
    /// Distance between light map coordinates in bytes, at least 8; 0: packed. Default: 0.
    pub lightmap_uv_stride: usize,
    /// Light map page of each triangle, packed; needs `lightmap_uvs`. May be NULL: all on page 0.
    /// Default: NULL.
    pub lightmap_page: *const u32,
    /// Material number of each triangle, packed. May be NULL: all have `material`. Default: NULL.
    pub triangle_materials: *const u32,
}

sized_struct!(bk_mesh_desc, defaults: bk_mesh_desc {
    struct_size: size_of::<bk_mesh_desc>() as u32,
    flags: 0,
    material: 0,
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
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_mesh_desc_init(desc: *mut bk_mesh_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a mesh. The materials that it names must have been added before.
///
/// @param scene  scene that is not committed
/// @param desc  the arrays are copied
/// @param out_id  receives the number of the mesh, as hits report it; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  an index or a material is out of range, or the mesh violates
///   BK_MESH_STRICT; bk_last_error names triangle and vertex
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit or the memory callback refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
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
        let device = &scene.device;
        let read = |held: &mut Reservation| {
            let mut mesh = read_mesh(&desc)?;
            device.install(|| mesh.move_to(device.storage(), &Progress::none()))?;
            held.shrink(held.bytes() - mesh.mapped_bytes());
            Ok(mesh)
        };
        let id = scene.describe_large("meshes can be added", bytes(&desc), read, SceneData::add_mesh)?;
        write_optional(out_id, id)
    })
}

/// Size of a copy of a mesh in bytes.
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
            positions: read_strided::<Vec3>(d.positions, d.position_stride, vertices, "positions")?.into(),
            indices: read_strided::<[u32; 3]>(d.indices, 0, triangles, "indices")?.into(),
            normals: read_optional::<Vec3>(d.normals, d.normal_stride, vertices, "normals")?.into(),
            uvs: read_optional::<Vec2>(d.uvs, d.uv_stride, vertices, "uvs")?.into(),
            lightmap: if d.lightmap_uvs.is_null() {
                None
            } else {
                Some(LightmapUvs {
                    uvs: read_strided::<Vec2>(d.lightmap_uvs, d.lightmap_uv_stride, vertices, "lightmap_uvs")?.into(),
                    pages: read_optional::<u32>(d.lightmap_page, 0, triangles, "lightmap_page")?.into(),
                })
            },
            materials: if d.triangle_materials.is_null() {
                MeshMaterials::One(d.material)
            } else {
                MeshMaterials::PerTriangle(
                    read_strided(d.triangle_materials, 0, triangles, "triangle_materials")?.into(),
                )
            },
            strict: d.flags & BK_MESH_STRICT != 0,
        })
    }
}

/// Sets new positions for all vertices of a mesh of a committed scene. Nothing changes before
/// bk_scene_refit, which applies the last positions that were set for each mesh.
///
/// Shading normals, texture coordinates and light map coordinates stay as they are. Positions that
/// are not finite are accepted, and their triangles are not hit after the refit, unless the mesh
/// has BK_MESH_STRICT.
///
/// @param scene  committed scene
/// @param mesh  number of the mesh
/// @param positions  `vertex_count` positions of three floats in scene units; copied
/// @param vertex_count  number of vertices, as when the mesh was added
/// @param stride  distance between positions in bytes, at least 12; 0: packed
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh, `vertex_count` or `stride` is wrong,
///   or the new positions violate BK_MESH_STRICT
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit
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

/// Returns the number of meshes of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of meshes; 0 on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_mesh_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.meshes().len(), |s| s.meshes().len()))
}

/// Pointers to the data of a mesh.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_mesh_view {
    /// Size of this structure in bytes, set by bk_mesh_view_init.
    pub struct_size: u32,
    /// Material number of all triangles if `triangle_materials` is NULL, else BK_NONE.
    pub material: u32,
    /// `vertex_count` positions of three floats, packed, in scene units.
    pub positions: *const f32,
    /// Number of vertices.
    pub vertex_count: usize,
    /// Three vertex numbers per triangle, packed.
    pub indices: *const u32,
    /// Number of triangles, degenerate ones included.
    pub triangle_count: usize,
    /// `vertex_count` shading normals of three floats, packed, unit vectors as they were given;
    /// NULL if the mesh has none.
    pub normals: *const f32,
    /// `vertex_count` texture coordinates of two floats, packed, 1 per width or height of an image;
    /// NULL if the mesh has none.
    pub uvs: *const f32,
    /// `vertex_count` light map coordinates of two floats in [0, 1], packed, as they were given;
    /// NULL if the mesh has none.
    pub lightmap_uvs: *const f32,
    /// Light map page of each triangle, packed, as it was given; NULL if all are on page 0.
    pub lightmap_page: *const u32,
    /// Material number of each triangle, packed; NULL if all have `material`.
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

/// Sets `struct_size` and clears the other fields.
///
/// @param view  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_mesh_view_init(view: *mut bk_mesh_view) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(view) }
}

/// Gets pointers to triangles and vertices of a mesh of a committed scene, without a copy.
///
/// @param scene  committed scene
/// @param mesh  number of the mesh
/// @param out  receives pointers that are valid while the scene lives, until the next
///   bk_scene_refit
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
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
