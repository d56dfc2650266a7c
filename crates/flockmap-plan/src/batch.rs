//! Many questions at once.

use flockmap_grid::{MapView, RayEnd, State, voxel_bit};

use crate::error::{QUESTION_BLOCKS_MAX, QuestionError};

/// States at many points (metres, frame of the map), as [`MapView::state_at`] has them: Unknown where there are no
/// voxels. A block is looked up twice at most for points in a row that lie in it.
pub fn states(view: &MapView, points: &[[f64; 3]], states: &mut [State]) -> Result<(), QuestionError> {
    same(points.len(), states.len())?;
    let (mut last, mut kept) = (None, None);
    for (point, state) in points.iter().zip(states) {
        *state = view.resolution().voxel_at(*point).map_or(State::Unknown, |voxel| {
            let index = voxel.block();
            if last != Some(index) {
                // A block is copied for the second point: few have one where points are anywhere.
                (last, kept) = (Some(index), None);
                return view.state(voxel);
            }
            let block = kept.get_or_insert_with(|| view.block(index));
            block.as_ref().map_or(State::Unknown, |block| block.get(voxel_bit(voxel)))
        });
    }
    Ok(())
}

/// [`MapView::cast_ray`] for many rays. Refused before any is cast if one of them is longer than
/// [`QUESTION_BLOCKS_MAX`] voxels, counted along the axes.
pub fn cast_rays(
    view: &MapView,
    from: &[[f64; 3]],
    to: &[[f64; 3]],
    through_unknown: bool,
    ends: &mut [RayEnd],
) -> Result<(), QuestionError> {
    same(from.len(), to.len())?;
    same(from.len(), ends.len())?;
    let side = view.resolution().metres();
    for (from, to) in from.iter().zip(to) {
        let voxels = from.iter().zip(to).map(|(a, b)| (b - a).abs()).sum::<f64>() / side;
        // Not what is no number: that ends at its start.
        if voxels.is_finite() && voxels > QUESTION_BLOCKS_MAX as f64 {
            return Err(QuestionError::TooLarge { blocks: voxels });
        }
    }
    for ((from, to), end) in from.iter().zip(to).zip(ends) {
        *end = view.cast_ray(*from, *to, through_unknown);
    }
    Ok(())
}

fn same(a: usize, b: usize) -> Result<(), QuestionError> {
    if a == b { Ok(()) } else { Err(QuestionError::Lengths(a, b)) }
}
