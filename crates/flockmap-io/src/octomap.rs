//! OctoMap's binary trees, `.bt`: each voxel free, occupied or unknown, two bits a child.
//!
//! The form (OctoMap's `OcTree::readBinaryData` and `AbstractOcTree::readHeader`): a text header, then the
//! nodes depth first. A node is two bytes with two bits for each of its eight children in the order x
//! fastest, z slowest: `00` unknown, `01` free, `10` occupied, `11` a node with children of its own, which
//! follow in the same order. The root spans 2¹⁶ voxels a side; the voxel with OctoMap's key 32768 has
//! index 0.

use std::path::Path;

use flockmap_grid::{Resolution, State, Voxel, VoxelBox};
use glam::DVec3;

use crate::bytes::Bytes;
use crate::error::{Fault, ReadError, WriteError, excerpt};
use crate::file::read_whole;
use crate::header_lines::HeaderLines;

/// Largest `.bt` file that is read.
pub const OCTOMAP_BYTES_MAX: u64 = 1 << 30;

/// Levels below the root: the root is at depth 0, single voxels are at depth 16.
const DEPTH: u32 = 16;
/// Indices run from −32,768 to 32,767 on each axis.
const HALF: i32 = 1 << (DEPTH - 1);
/// The lowest voxel of the root.
const ROOT: Voxel = Voxel::new(-HALF, -HALF, -HALF);
const FIRST_LINE: &str = "# Octomap OcTree binary file";

/// A cube of voxels that all have one state: a leaf of the tree.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Cube {
    /// The voxel at the lowest corner.
    pub corner: Voxel,
    /// Voxels along each side: a power of two, 1 … 32,768.
    pub side: u32,
    /// Free or Occupied.
    pub state: State,
}

impl Cube {
    /// The voxels of the cube, x slowest and z fastest.
    pub fn voxels(&self) -> impl Iterator<Item = Voxel> + use<> {
        VoxelBox::new(self.corner, [self.side; 3]).into_iter().flat_map(|cube| cube.voxels())
    }

    /// Number of voxels.
    pub const fn volume(&self) -> u64 {
        (self.side as u64).pow(3)
    }
}

/// An OctoMap as read from a `.bt` file. Held as its leaves, 20 bytes each; large leaves are not taken apart.
#[derive(Clone, PartialEq, Debug)]
pub struct OctoMap {
    resolution: Resolution,
    cubes: Vec<Cube>,
    nodes: u64,
}

impl OctoMap {
    /// Reads a `.bt` file of at most [`OCTOMAP_BYTES_MAX`] bytes. Memory: the file and at most 80 bytes for
    /// each of its bytes.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, ReadError> {
        let path = path.as_ref();
        Self::parse(&read_whole(path, OCTOMAP_BYTES_MAX)?).map_err(|fault| fault.in_file(path))
    }

    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, Fault> {
        let mut header = HeaderLines::new(bytes);
        let (size, resolution) = parse_header(&mut header)?;
        let mut data = Bytes::new(header.rest(), header.at() as u64);
        let mut cubes = Vec::new();
        let nodes = if size > 0 { 1 + read_node(&mut data, ROOT, 0, &mut cubes)? } else { 0 };
        if nodes != size {
            let expected = format!("{size} nodes, as the header says");
            return Err(Fault::damaged(data.place(), expected, format!("{nodes} nodes")));
        }
        Ok(Self { resolution, cubes, nodes })
    }

    /// Side of a voxel.
    pub const fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// Nodes of the tree, inner ones included, as its header says.
    pub const fn nodes(&self) -> u64 {
        self.nodes
    }

    /// The leaves, depth first.
    pub fn cubes(&self) -> &[Cube] {
        &self.cubes
    }

    /// Every known voxel with its state. A large free leaf may be billions of voxels: look at
    /// [`Self::voxel_count`] first.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> + '_ {
        self.cubes.iter().flat_map(|cube| cube.voxels().map(|voxel| (voxel, cube.state)))
    }

    /// As [`Self::voxels`], without borrowing.
    pub fn into_voxels(self) -> impl Iterator<Item = (Voxel, State)> {
        self.cubes.into_iter().flat_map(|cube| cube.voxels().map(move |voxel| (voxel, cube.state)))
    }

    /// Number of known voxels with this state.
    pub fn voxel_count(&self, state: State) -> u64 {
        self.cubes.iter().filter(|cube| cube.state == state).map(Cube::volume).sum()
    }

    /// Corners of the smallest box that holds all known voxels, in metres. `None` if there is none.
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        let side = self.resolution.metres();
        let corners = |cube: &Cube| {
            let low = DVec3::from([cube.corner.x, cube.corner.y, cube.corner.z].map(f64::from)) * side;
            [low, low + f64::from(cube.side) * side]
        };
        let both = self.cubes.iter().map(corners).reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
        both.map(|corners| corners.map(DVec3::into))
    }
}

/// The leaves of a bare tree: what stands in a `.bt` file after its header. `None` if it is cut short, goes
/// below depth 16, or does not end where the bytes do. Memory: at most 80 bytes for each of the bytes.
pub fn read_octomap_tree(bytes: &[u8]) -> Option<Vec<Cube>> {
    let (mut data, mut cubes) = (Bytes::new(bytes, 0), Vec::new());
    read_node(&mut data, ROOT, 0, &mut cubes).ok()?;
    data.rest().is_empty().then_some(cubes)
}

/// Takes over the node at `depth` whose lowest voxel is `corner`, and all below it. Returns the number of
/// nodes below it. At most 16 calls deep.
fn read_node(data: &mut Bytes<'_>, corner: Voxel, depth: u32, cubes: &mut Vec<Cube>) -> Result<u64, Fault> {
    let place = data.place();
    let children = data.u16("children of a node")?;
    let side = 1i32 << (DEPTH - depth - 1);
    let corners: [Voxel; 8] = core::array::from_fn(|child| {
        let step = |axis: usize| side * (child >> axis & 1) as i32;
        Voxel::new(corner.x + step(0), corner.y + step(1), corner.z + step(2))
    });
    let children = || corners.into_iter().enumerate().map(|(i, corner)| (corner, children >> (2 * i) & 3));
    let mut nodes = 0;
    for (corner, bits) in children() {
        let state = match bits {
            0 => continue,
            1 => State::Free,
            2 => State::Occupied,
            _ if depth + 1 == DEPTH => {
                let found = "a node with children there";
                return Err(Fault::damaged(place, "no nodes below depth 16", found));
            }
            _ => State::Unknown,
        };
        if state != State::Unknown {
            cubes.push(Cube { corner, side: side as u32, state });
        }
        nodes += 1;
    }
    // A node is written whole before the nodes below it.
    for (corner, _) in children().filter(|(_, bits)| *bits == 3) {
        nodes += read_node(data, corner, depth + 1, cubes)?;
    }
    Ok(nodes)
}

/// Nodes of the tree, and side of a voxel.
fn parse_header(lines: &mut HeaderLines<'_>) -> Result<(u64, Resolution), Fault> {
    let (mut id, mut size, mut resolution) = (None, None, None);
    loop {
        let text = lines.next("the header of an OctoMap up to the line \"data\"")?;
        let line = String::from_utf8_lossy(text);
        let mut words = line.split_ascii_whitespace();
        let quoted = |word: &str| excerpt(word.as_bytes());
        let place = lines.place();
        match (words.next(), words.next()) {
            _ if lines.line() == 1 => {
                if !line.starts_with(FIRST_LINE) {
                    return Err(Fault::foreign(place, format!("\"{FIRST_LINE}\""), excerpt(text)));
                }
            }
            (None, _) => {}
            (Some(word), _) if word.starts_with('#') => {}
            (Some("data"), None) => break,
            (Some("id"), Some("OcTree")) => id = Some(()),
            (Some("id"), Some(word)) => {
                return Err(Fault::foreign(place, "a tree of type OcTree", quoted(word)));
            }
            (Some("size"), Some(word)) => {
                let nodes: Option<u64> = word.parse().ok();
                size = Some(nodes.ok_or_else(|| Fault::damaged(place, "a number of nodes", quoted(word)))?);
            }
            (Some("res"), Some(word)) => {
                let metres = word.parse().ok().and_then(Resolution::from_metres);
                let expected = "a resolution of 0.001 to 100 m";
                resolution = Some(metres.ok_or_else(|| Fault::damaged(place, expected, quoted(word)))?);
            }
            _ => {
                let expected = "a line \"id …\", \"size …\", \"res …\", \"data\" or a comment";
                return Err(Fault::damaged(place, expected, excerpt(text)));
            }
        }
    }
    let missing =
        |what: &str| Fault::damaged(lines.place(), format!("a line \"{what} …\" before the data"), "none");
    id.ok_or_else(|| missing("id"))?;
    let size = size.ok_or_else(|| missing("size"))?;
    let resolution = resolution.ok_or_else(|| missing("res"))?;
    if size == 1 {
        let found = "a single node, whose state the binary form does not store";
        return Err(Fault::foreign(lines.place(), "a tree with leaves below its root", found));
    }
    Ok((size, resolution))
}

/// A `.bt` file that OctoMap's own tools read. Fails if an index is outside −32,768 … 32,767.
pub(crate) fn octomap_bytes(
    path: &Path,
    resolution: Resolution,
    voxels: impl IntoIterator<Item = (Voxel, State)>,
) -> Result<Vec<u8>, WriteError> {
    let (data, nodes) = octomap_tree(voxels).map_err(|voxel| {
        let why = format!("an OctoMap reaches from index {} to {} on each axis", -HALF, HALF - 1);
        WriteError::unfit(path, format!("voxel {voxel:?}"), why)
    })?;
    let note = "# (feel free to add / change comments, but leave the first line as it is!)\n#";
    let res = resolution.metres();
    let header = format!("{FIRST_LINE}\n{note}\nid OcTree\nsize {nodes}\nres {res}\ndata\n");
    Ok([header.as_bytes(), &data].concat())
}

/// A bare tree of these voxels, and its number of nodes with the root; eight equal leaves are joined to one.
/// Of two entries for one voxel the later counts; Unknown entries are left out. Memory: 24 bytes a voxel.
///
/// # Errors
/// Gives a voxel with an index outside −32,768 … 32,767.
pub fn octomap_tree(voxels: impl IntoIterator<Item = (Voxel, State)>) -> Result<(Vec<u8>, u64), Voxel> {
    let mut known = Vec::new();
    for (voxel, state) in voxels.into_iter().filter(|(_, state)| *state != State::Unknown) {
        known.push((morton(voxel).ok_or(voxel)?, state));
    }
    // Turned round, the one that came last stands first among its equals, and the first is kept.
    known.reverse();
    known.sort_by_key(|(code, _)| *code);
    known.dedup_by_key(|(code, _)| *code);
    let mut data = Vec::new();
    let nodes = if known.is_empty() { 0 } else { 1 + write_node(&known, 0, &mut data) };
    Ok((data, nodes))
}

/// A voxel by its path, three bits a level, the root's children in the highest of 48 bits.
type Known = (u64, State);

/// The path to a voxel: three bits a level (x, y, z from bit 0), highest level first.
fn morton(voxel: Voxel) -> Option<u64> {
    let key = |index: i32| u16::try_from(index.checked_add(HALF)?).ok();
    let (x, y, z) = (key(voxel.x)?, key(voxel.y)?, key(voxel.z)?);
    let bits = |v: u16| (0..16).fold(0u64, |code, bit| code | u64::from(v >> bit & 1) << (3 * bit));
    Some(bits(x) | bits(y) << 1 | bits(z) << 2)
}

/// Whether voxels of one cube fill it, and all have one state: then the cube is a leaf. `bits` is the length
/// of a path within it.
fn are_one_leaf(voxels: &[Known], bits: u32) -> bool {
    voxels.len() as u64 == 1 << bits && voxels.windows(2).all(|pair| pair[0].1 == pair[1].1)
}

/// Writes the node at `depth` that holds just these voxels, and all below it. Returns the number of nodes
/// below it.
fn write_node(voxels: &[Known], depth: u32, data: &mut Vec<u8>) -> u64 {
    let shift = 3 * (DEPTH - depth - 1);
    let mut children = 0u16;
    let mut nodes = 0;
    let parts: [&[Known]; 8] = core::array::from_fn(|child| {
        let start = voxels.partition_point(|(code, _)| ((code >> shift & 7) as usize) < child);
        let end = voxels.partition_point(|(code, _)| (code >> shift & 7) as usize <= child);
        voxels.get(start..end).unwrap_or_default()
    });
    for (child, part) in parts.iter().enumerate() {
        let bits = match part.first() {
            None => continue,
            Some(_) if !are_one_leaf(part, shift) => 3,
            Some((_, State::Free)) => 1,
            Some(_) => 2,
        };
        nodes += 1;
        children |= bits << (2 * child);
    }
    data.extend_from_slice(&children.to_le_bytes());
    for (child, part) in parts.iter().enumerate() {
        if children >> (2 * child) & 3 == 3 {
            nodes += write_node(part, depth + 1, data);
        }
    }
    nodes
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn write(voxels: &[(Voxel, State)]) -> Vec<u8> {
        let resolution = Resolution::from_metres(0.05).unwrap();
        octomap_bytes(Path::new("test.bt"), resolution, voxels.iter().copied()).unwrap()
    }

    fn some_voxels() -> impl Strategy<Value = Vec<(Voxel, State)>> {
        let coordinate = prop_oneof![-4..4i32, -32768..32768i32];
        let voxel =
            (coordinate.clone(), coordinate.clone(), coordinate).prop_map(|(x, y, z)| Voxel::new(x, y, z));
        prop::collection::vec((voxel, prop_oneof![Just(State::Free), Just(State::Occupied)]), 0..300)
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(voxels in some_voxels()) {
            let map = OctoMap::parse(&write(&voxels)).unwrap();
            let model: BTreeMap<Voxel, State> = voxels.into_iter().collect();
            let occupied = model.values().filter(|&&s| s == State::Occupied).count() as u64;
            prop_assert_eq!(map.voxels().collect::<BTreeMap<_, _>>(), model);
            prop_assert_eq!(map.voxel_count(State::Occupied), occupied);
        }

        #[test]
        fn damage_is_an_error_or_another_map_but_never_a_panic(
            voxels in some_voxels(), cut in 0.0..1.0f64, flip in any::<prop::sample::Index>(), bit in 0..8u8,
        ) {
            let bytes = write(&voxels);
            let cut = (bytes.len() as f64 * cut) as usize;
            prop_assert!(OctoMap::parse(&bytes[..cut]).is_err());
            let mut flipped = bytes;
            let at = flip.index(flipped.len());
            flipped[at] ^= 1 << bit;
            if let Ok(map) = OctoMap::parse(&flipped) {
                prop_assert!(map.cubes().len() <= flipped.len() * 4);
            }
        }

        #[test]
        fn random_bytes_after_a_header_never_panic(data in prop::collection::vec(any::<u8>(), 0..2000), size in 0..1000u64) {
            let mut bytes = format!("{FIRST_LINE}\nid OcTree\nsize {size}\nres 0.1\ndata\n").into_bytes();
            bytes.extend(data);
            let _ = OctoMap::parse(&bytes);
        }
    }

    #[test]
    fn eight_equal_voxels_become_one_leaf() {
        let cube = Cube { corner: Voxel::new(-8, 0, 8), side: 4, state: State::Free };
        let voxels: Vec<_> = cube.voxels().map(|v| (v, State::Free)).collect();
        let map = OctoMap::parse(&write(&voxels)).unwrap();
        assert_eq!(map.cubes(), &[cube]);
        assert_eq!(map.nodes(), 15);
        assert_eq!(map.bounds().unwrap()[0][0], -0.4);
    }

    #[test]
    fn bytes_are_as_octomap_writes_them() {
        // The voxel with key (32768, 32768, 32768): child 7 of the root, then child 0 of each node.
        let bytes = write(&[(Voxel::new(0, 0, 0), State::Occupied)]);
        let at = bytes.windows(5).position(|w| w == b"data\n").unwrap() + 5;
        let mut expected = vec![0x00, 0xc0];
        for _ in 0..14 {
            expected.extend([0x03, 0x00]);
        }
        expected.extend([0x02, 0x00]);
        assert_eq!(&bytes[at..], &expected);
        let header = String::from_utf8_lossy(&bytes[..at]).into_owned();
        assert!(header.contains("\nid OcTree\nsize 17\nres 0.05\ndata\n"), "{header}");
    }

    #[test]
    fn an_empty_map_is_a_map() {
        let map = OctoMap::parse(&write(&[])).unwrap();
        assert!(map.cubes().is_empty() && map.bounds().is_none());
    }

    #[test]
    fn errors_name_the_line_and_what_was_expected() {
        let error =
            |text: &str| OctoMap::parse(text.as_bytes()).unwrap_err().in_file(Path::new("a.bt")).to_string();
        assert!(error("ply\n").starts_with("a.bt: line 1: cannot be used: expected \"# Octomap OcTree"));
        let full = "# Octomap OcTree file\nid OcTree\n";
        assert!(error(full).contains("found \"# Octomap OcTree file\""));
        let head = "# Octomap OcTree binary file\n";
        assert!(error(&format!("{head}id ColorOcTree\n")).contains("line 2: cannot be used"));
        assert!(error(&format!("{head}id OcTree\nsize 3\nres 0\ndata\n")).contains("line 4"));
        assert!(error(&format!("{head}id OcTree\nsize 3\ndata\n")).contains("a line \"res …\""));
        assert!(error(&format!("{head}id OcTree\nsize 5\nres 0.1\ndata\n\0\0")).contains("5 nodes"));
        assert!(error(&format!("{head}id OcTree\nsize 3\nres 0.1\ndata\n")).contains("ends too early"));
    }

    #[test]
    fn a_voxel_beyond_octomaps_reach_is_refused() {
        let voxel = [(Voxel::new(32768, 0, 0), State::Free)];
        let resolution = Resolution::from_metres(0.1).unwrap();
        let error = octomap_bytes(Path::new("a.bt"), resolution, voxel).unwrap_err();
        assert!(error.to_string().contains("(32768, 0, 0)"), "{error}");
    }
}
