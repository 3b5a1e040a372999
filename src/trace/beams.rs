//! Beams: rays of a [stream](super::stream) to any hit that go the same way, as shadow rays of a tile to a lamp do,
//! pass the tree in packs of sixteen (packets of shadow rays: Wald et al., *Interactive Rendering with Coherent Ray
//! Tracing*, 2001; what encloses them: Haines and Wallace, *Shaft Culling for Efficient Ray-Cast Radiosity*, 1991).
//!
//! ```text
//! push (root, the packs of an octant)
//! while (child, packs) is popped, without the packs whose rays all have their hit:
//!     node:  test the shaft around each pack against the eight children;
//!            for each child that any meets, from least to most worth: push (child, packs that meet it)
//!     leaf:  for each pack, find the rays that hit the leaf's box, and test them against one triangle after another
//! ```
//!
//! Sixteen rays that follow one another and go the same way are a pack as they are; others wait until there are sixteen
//! of their octant and longest axis. So rays are loaded once, and the same vectors tell their keys, make the
//! [shaft](super::packs) and the setup. What is in no narrow shaft, and packs that turn out not to be worth it, are left
//! to lists.
//!
//! Answers are those of [`single`](super::single), bit for bit. A triangle counts for rays that hit the box of its leaf
//! by the arithmetic of single rays. As rounding is monotonic, such rays hit all boxes around it; and so does the
//! shaft, since it is wider than its rays by more than rounding.

use super::Ray;
use super::groups::{ChildBoxes, axes_of};
use super::packs::{Eights, Pack, SIZE, Shaft};
use super::ray_keys::{SPECIAL, is_uniform, keys_of};
use super::tree::Tree;
use crate::bvh::Mbvh;
use crate::bvh::layout::{ChildRef, STACK_SIZE};
use crate::simd::{Eight, Lanes, Mask, Simd};
use std::array::from_fn;
use std::mem::MaybeUninit;

/// Number of packs that go down the tree together.
pub(super) const PACKS: usize = 32;

/// Number of leaves after which a pack's trial ends, and the number of rays per test of a leaf that must have hit its box
/// until then and from then on. (Against 4 leaves and two rays per test, for all packs of a group together: rays to a
/// lamp are 1.1 to 1.55 times as fast, those to a light of four times the tile's size 1.0 to 1.3 times; without
/// the trial the latter have 0.03 to 0.21 times the speed.)
const TRIAL: u32 = 16;
const LEAST_MET: u32 = 1;

/// Number of packs after which a stream's packs are given up if most are wide.
const TRIED: usize = 3;

/// Least number of rays of a pack that is not full.
const LEAST: usize = 4;

/// A child that waits for its visit, the packs that meet its box, and where its planes are.
#[derive(Clone, Copy)]
struct Entry {
    child: ChildRef,
    packs: u32,
    parent: ChildRef,
    lane: u32,
}

/// Working memory of beams.
pub(super) struct Room {
    /// [`PACKS`] each.
    pub shafts: Vec<Shaft>,
    pub packs: Vec<Pack>,
    /// Numbers of rays that wait until there are enough of their key for a pack, by key.
    pub waiting: Vec<[u16; 2 * SIZE]>,
}

/// Traces rays to any hit below the node `root` in packs, as far as that is worth it: rays that follow one another and
/// go the same way, and those of the others that do. `done` receives the numbers of these rays, and whether they hit anything; `keys` those of
/// all rays, and `rest` the numbers of the rays that are left.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn trace<S: Simd>(
    tree: &Mbvh,
    root: ChildRef,
    rays: &[Ray],
    room: &mut Room,
    keys: &mut [u8],
    rest: &mut Vec<u16>,
    done: impl FnMut(usize, bool),
) {
    let mut beams = Beams { tree, root, room, rest, done, count: 0, octants: [0; 8], narrow: 0, wide: 0 };
    // The next ray; the next key at the end; how many rays of each key wait, and for which keys that is enough.
    let (mut next, mut last_key) = (0, 0);
    let (mut waiting, mut ready) = ([0; SPECIAL], 0u32);
    // (One loop, so that packs are made and traced in one place each: all is compiled into the entry points.)
    loop {
        let (mut numbers, mut count, mut key) = ([0; SIZE], SIZE, SPECIAL);
        if ready != 0 {
            key = ready.trailing_zeros() as usize;
            ready &= ready - 1;
            waiting[key] -= SIZE;
            numbers.copy_from_slice(&beams.room.waiting[key][..SIZE]);
            beams.room.waiting[key].copy_within(SIZE.., 0);
        } else if next < rays.len() {
            count = (rays.len() - next).min(SIZE);
            for (i, number) in numbers.iter_mut().enumerate() {
                *number = (next + i.min(count - 1)) as u16;
            }
        } else {
            while last_key < SPECIAL && (waiting[last_key] < LEAST || beams.is_futile()) {
                beams.rest.extend_from_slice(&beams.room.waiting[last_key][..waiting[last_key]]);
                last_key += 1;
            }
            if last_key < SPECIAL {
                (key, count) = (last_key, waiting[last_key]);
                for (i, number) in numbers.iter_mut().enumerate() {
                    *number = beams.room.waiting[key][i.min(count - 1)];
                }
                last_key += 1;
            } else {
                count = 0;
            }
        }
        if beams.count == PACKS || count == 0 {
            // SAFETY: forwarded.
            unsafe { beams.flush::<S>() };
        }
        if count == 0 {
            return;
        }
        // SAFETY: forwarded.
        let halves = unsafe { [load::<S::F8>(rays, &numbers, 0), load::<S::F8>(rays, &numbers, 8)] };
        if key == SPECIAL {
            // SAFETY: forwarded.
            let [low, high] = unsafe { [keys_of(halves[0]), keys_of(halves[1])] };
            keys[next..next + 8].copy_from_slice(&low);
            keys[next + 8..next + SIZE].copy_from_slice(&high);
            if beams.is_futile() {
                beams.rest.extend_from_slice(&numbers[..count]);
                next += count;
                continue;
            }
            if low != high || !is_uniform(low) || low[0] as usize == SPECIAL {
                for (&number, &key) in numbers[..count].iter().zip(&keys[next..]) {
                    let key = key as usize;
                    if key == SPECIAL {
                        beams.rest.push(number);
                        continue;
                    }
                    beams.room.waiting[key][waiting[key]] = number;
                    waiting[key] += 1;
                    ready |= u32::from(waiting[key] >= SIZE) << key;
                }
                next += count;
                continue;
            }
            next += count;
            key = low[0] as usize;
        }
        // SAFETY: forwarded.
        unsafe { beams.add::<S>(halves, numbers, count, key) };
    }
}

/// Loads eight rays, whose numbers are those from `first` on. (Functions: closures were not inlined.)
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn load<L: Eight>(rays: &[Ray], numbers: &[u16; SIZE], first: usize) -> Eights<L> {
    // SAFETY: forwarded.
    unsafe {
        L::transpose([
            load_one(rays, numbers[first]),
            load_one(rays, numbers[first + 1]),
            load_one(rays, numbers[first + 2]),
            load_one(rays, numbers[first + 3]),
            load_one(rays, numbers[first + 4]),
            load_one(rays, numbers[first + 5]),
            load_one(rays, numbers[first + 6]),
            load_one(rays, numbers[first + 7]),
        ])
    }
}

/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn load_one<L: Eight>(rays: &[Ray], number: u16) -> L {
    // SAFETY: a ray is eight floats. The caller vouches for the ISA.
    unsafe { L::load(std::ptr::from_ref(&rays[number as usize]).cast::<f32>()) }
}

/// Packs of a stream that have not been traced yet.
struct Beams<'a, F> {
    tree: &'a Mbvh,
    root: ChildRef,
    room: &'a mut Room,
    rest: &'a mut Vec<u16>,
    done: F,
    /// Number of packs, and which of them are of which octant.
    count: usize,
    octants: [u32; 8],
    /// Number of packs of the stream that were worth it, and of those that were not.
    narrow: usize,
    wide: usize,
}

impl<F: FnMut(usize, bool)> Beams<'_, F> {
    /// Whether too many packs have been too wide.
    #[inline(always)]
    fn is_futile(&self) -> bool {
        self.wide >= TRIED && 3 * self.wide > self.narrow
    }

    /// Makes a pack of rays of one key, the last of which takes the places of those beyond their number, if that is worth
    /// it.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn add<S: Simd>(&mut self, halves: [Eights<S::F8>; 2], numbers: [u16; SIZE], count: usize, key: usize) {
        let (octant, axis) = (key / 3, key % 3);
        // SAFETY: forwarded.
        let shaft = unsafe { Shaft::new::<S>(&halves, octant, self.tree) };
        let Some(shaft) = shaft else {
            self.wide += 1;
            self.rest.extend_from_slice(&numbers[..count]);
            return;
        };
        self.narrow += 1;
        self.room.shafts[self.count] = shaft;
        let pack = &mut self.room.packs[self.count];
        (pack.numbers, pack.count, pack.axes) = (numbers, count as u32, *axes_of(octant, axis));
        // SAFETY: forwarded.
        unsafe { pack.set_up::<S>(&halves) };
        self.octants[octant] |= 1 << self.count;
        self.count += 1;
    }

    /// Traces the packs.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn flush<S: Simd>(&mut self) {
        let mut given_up = 0;
        for (octant, packs) in std::mem::take(&mut self.octants).into_iter().enumerate() {
            if packs != 0 {
                let Room { shafts, packs: all, .. } = &mut *self.room;
                // SAFETY: forwarded; the packs have been set up.
                given_up |=
                    unsafe { Traversal { tree: self.tree, shafts, packs: all, octant }.run::<S>(self.root, packs) };
            }
        }
        for (i, pack) in self.room.packs[..std::mem::take(&mut self.count)].iter().enumerate() {
            let is_given_up = given_up >> i & 1 != 0;
            for (i, &number) in pack.numbers[..pack.count as usize].iter().enumerate() {
                let is_hit = pack.left >> i & 1 == 0;
                match is_given_up && !is_hit {
                    true => self.rest.push(number),
                    false => (self.done)(number as usize, is_hit),
                }
            }
        }
    }
}

/// The traversal of up to [`PACKS`] packs of an octant.
struct Traversal<'a> {
    tree: &'a Mbvh,
    shafts: &'a [Shaft],
    packs: &'a mut [Pack],
    octant: usize,
}

impl Traversal<'_> {
    /// Traces the packs of a set. Returns those that were given up: too few of their rays hit the leaves that their shafts
    /// meet.
    ///
    /// # Safety
    /// The CPU must have the ISA, and the packs must have been set up.
    #[inline(always)]
    unsafe fn run<S: Simd>(&mut self, root: ChildRef, mut left: u32) -> u32 {
        let mut given_up = 0;
        let mut stack = [const { MaybeUninit::<Entry>::uninit() }; STACK_SIZE];
        stack[0].write(Entry { child: root, packs: left, parent: root, lane: 0 });
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            // SAFETY: entries below `depth` have been written; children of the tree are its nodes and leaves; the
            // builder bounds the tree's depth so that there is room on the stack (see `STACK_SIZE`).
            unsafe {
                let mut entry = stack.get_unchecked(depth).assume_init();
                entry.packs &= left;
                if entry.packs == 0 {
                    continue;
                }
                if entry.child.is_leaf() {
                    let (finished, useless) = self.visit_leaf::<S>(entry);
                    left &= !finished & !useless;
                    given_up |= useless;
                } else {
                    depth += self.visit_node::<S>(entry, stack.as_mut_ptr().add(depth).cast());
                }
            }
        }
        given_up
    }

    /// Tests packs against the children of a node, and pushes those that any meets. Returns how many.
    ///
    /// # Safety
    /// The CPU must have the ISA; `entry` must be of a node of the tree, and `stack` have room for eight entries.
    #[inline(always)]
    unsafe fn visit_node<S: Simd>(&self, entry: Entry, stack: *mut Entry) -> usize {
        // SAFETY: forwarded; packs are below the number of shafts, which is up to that of masks.
        unsafe {
            let node = self.tree.node(entry.child);
            let boxes = ChildBoxes::new::<S, Mbvh>(node, self.octant);
            let mut masks = [0u8; PACKS];
            let (mut met, mut packs) = (0, entry.packs);
            while packs != 0 {
                let pack = packs.trailing_zeros() as usize;
                packs &= packs - 1;
                let bits = self.shafts.get_unchecked(pack).meets(&boxes).bits();
                *masks.get_unchecked_mut(pack) = bits as u8;
                met |= bits;
            }
            // (As soon as the first pack has met them: 0.93 times as fast.)
            let name = |lane: u32| *node.children.get_unchecked(lane as usize);
            let mut children = met;
            while children != 0 {
                self.tree.prefetch_whole(name(children.trailing_zeros()));
                children &= children - 1;
            }
            let mut pushed = 0;
            while met != 0 {
                let lane = met.trailing_zeros();
                met &= met - 1;
                let packs = S::column(&masks, lane);
                stack.add(pushed).write(Entry { child: name(lane), packs, parent: entry.child, lane });
                pushed += 1;
            }
            pushed
        }
    }

    /// Tests packs against a leaf. Returns those whose rays all have their hit, and those that are given up.
    ///
    /// # Safety
    /// The CPU must have the ISA; `entry` must be of a leaf of the tree.
    #[inline(always)]
    unsafe fn visit_leaf<S: Simd>(&mut self, entry: Entry) -> (u32, u32) {
        // SAFETY: forwarded; packs are below the number of those that were set up.
        unsafe {
            let (rows, count) = (self.tree.leaf(entry.child), entry.child.leaf_count());
            let (node, lane) = (self.tree.node(entry.parent), entry.lane as usize);
            let planes = from_fn(|a| {
                let [lower, upper] = [*node.lower[a].get_unchecked(lane), *node.upper[a].get_unchecked(lane)];
                if self.octant >> a & 1 != 0 { [upper, lower] } else { [lower, upper] }
            });
            let (mut packs, mut finished, mut useless) = (entry.packs, 0, 0);
            while packs != 0 {
                let number = packs.trailing_zeros();
                packs &= packs - 1;
                let pack = self.packs.get_unchecked_mut(number as usize);
                pack.tests += 1;
                for first in (0..SIZE).step_by(S::Packet::WIDTH) {
                    pack.met += pack.test::<S>(first, &planes, rows, count);
                }
                finished |= u32::from(pack.left == 0) << number;
                useless |= u32::from(pack.tests > TRIAL && pack.met < LEAST_MET * pack.tests) << number;
            }
            (finished, useless & !finished)
        }
    }
}
