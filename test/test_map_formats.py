"""
Clouds and meshes of other programs: the points that are in the file, or an error that says where.

What a file promises and does not hold is refused; what is not used is said; nothing that was cut
anywhere, in any dialect, gives a value that was never written.
"""

import gzip
import struct

from continuum_loc.errors import MapError
from continuum_loc.formats.content import bytes_of, SMALL
from continuum_loc.formats.reading import read_shape, READERS
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import PriorMap
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from studies.support import dialects
from studies.support.dialects import xyz

POINTS = np.random.default_rng(5).uniform([-1, -1, 0], [1, 1, 2], (60, 3)).round(4)
SINGLE = POINTS.astype(np.float32).astype(np.float64)
FORMS = ('ascii', 'binary_little_endian', 'binary_big_endian')
ENCODINGS = ('ascii', 'binary', 'binary_compressed')
COLOURS = np.random.default_rng(6).integers(90, 190, (60, 3))


def shape(suffix, content):
    """Read bytes or a text as the file `part.SUFFIX`."""
    data = content.encode() if isinstance(content, str) else content
    return READERS[suffix](data, f'part{suffix}')


def refused(suffix, content, said):
    with pytest.raises(MapError, match=said) as error:
        shape(suffix, content)
    message = str(error.value)
    assert message.startswith(f'part{suffix}')
    assert '\n' not in message and len(message) < 400


def cut_rows(data, rows):
    """Take the last rows of a text, or bytes, away."""
    return b'\n'.join(data.split(b'\n')[: -rows - 1]) + b'\n'


# Cut short


def test_an_ascii_ply_that_ends_after_48_of_60_points_is_refused():
    refused('.ply', cut_rows(dialects.ply(xyz(POINTS)), 12), 'ends after 48 of 60 points')


@pytest.mark.parametrize('form', FORMS[1:])
def test_a_binary_ply_that_ends_after_48_of_60_points_is_refused(form):
    whole = dialects.ply(xyz(POINTS), form)
    refused('.ply', whole[: -12 * 12], 'ends after 48 of 60 points')
    refused('.ply', whole[: -12 * 12 - 5], 'ends after 47 of 60 points')


def test_an_ascii_pcd_that_ends_after_48_of_60_points_is_refused():
    refused('.pcd', cut_rows(dialects.pcd(xyz(POINTS), 'ascii'), 12), 'ends after 48 of 60 points')


def test_a_binary_pcd_that_ends_after_48_of_60_points_is_refused():
    refused('.pcd', dialects.pcd(xyz(POINTS))[: -12 * 12], 'ends after 48 of 60 points')


def test_a_pts_that_ends_after_48_of_60_points_is_refused():
    rows = dialects.text(dict(zip('xyz', POINTS.T, strict=True)), before=['60']).encode()
    np.testing.assert_array_equal(shape('.pts', rows).points, POINTS)
    refused('.pts', cut_rows(rows, 12), 'says 60 points and ends after 48')
    refused('.xyz', rows + b'0 0 0\n', 'says 60 points and holds 61')


@pytest.mark.parametrize(
    ('suffix', 'whole', 'size'),
    [
        *(('.ply', dialects.ply(xyz(POINTS), form), 12) for form in FORMS[1:]),
        ('.pcd', dialects.pcd(xyz(POINTS)), 12),
    ],
)
def test_more_points_than_the_header_says_are_refused_too(suffix, whole, size):
    """60 single-precision points under a header of 60 in double precision would be 30 others."""
    refused(suffix, whole + bytes(range(1, size + 1)), f'goes on for {size} bytes')
    refused(suffix, whole + bytes(size), f'goes on for {size} bytes')
    assert len(shape(suffix, whole + b'\n').points) == 60


def test_a_last_number_that_may_lack_digits_is_refused_and_one_that_cannot_is_read():
    """Of 1.2500 and 7.125 the second may have been 7.1250 or 7.1259."""
    assert shape('.xyz', '0.5000 1.0000 1.2500\n0.5000 1.0000 7.1250').points[1, 2] == 7.125
    refused('.xyz', '0.5000 1.0000 1.2500\n0.5000 1.0000 7.125', 'line 2: the file ends within')
    refused('.xyz', '1 2 3\n4 5 6', 'line 2: the file ends within')
    assert shape('.xyz', '1 2 3\n4 5 6\n').points[1, 2] == 6.0
    refused('.ply', dialects.ply(xyz(POINTS))[:-3], 'the file ends within this line')


def test_an_index_that_may_lack_digits_is_refused_and_one_that_cannot_is_read():
    """With 24 vertices 2 may have been 20 to 24, and 3 can only be 3."""
    vertices = np.random.default_rng(0).uniform(0, 1, (24, 3))
    refused('.obj', dialects.obj(vertices, [[0, 2, 4], [3, 2, 1]])[:-1], 'its last number may')
    whole = dialects.obj(vertices, [[0, 2, 4], [3, 1, 2]])
    np.testing.assert_array_equal(shape('.obj', whole[:-1]).faces, [[0, 2, 4], [3, 1, 2]])
    refused('.obj', dialects.obj(vertices, [[0, 2, 4, 6], [5, 6, 7]])[:-1], 'its last number may')


def test_a_cut_stl_is_refused_whatever_its_head_says():
    vertices, sides = dialects.box([0, 0, 0], [1, 1, 1])
    corners = vertices[np.array(dialects.triangles(sides))]
    for head in (b'binary', b'solid of a program that does not know better'):
        whole = dialects.stl(corners, head)
        assert shape('.stl', whole).faces.shape == (12, 3)
        refused('.stl', whole[:-120], 'ends after 9 of 12 triangles')
        refused('.stl', whole + bytes(50), 'says 12 triangles, which are 684 bytes, and has 734')
    refused('.stl', dialects.stl(corners, count=4_000_000_000), 'ends after 12 of 4000000000')
    text = dialects.ascii_stl(corners)
    np.testing.assert_array_equal(shape('.stl', text).vertices.reshape(-1, 3, 3), corners)
    refused('.stl', text[: text.index('endsolid')], 'without `endsolid`: it was cut')
    refused('.stl', text[:500], 'line 1[0-9]|it was cut')


def test_an_obj_that_lacks_faces_which_its_comments_count_is_refused():
    vertices, sides = dialects.box([0, 0, 0], [1, 1, 1])
    text = dialects.obj(vertices, dialects.triangles(sides))
    assert len(shape('.obj', f'# Vertices: 8\n# Faces: 12\n{text}').faces) == 12
    refused('.obj', f'# Vertices: 8\n# Faces: 14\n{text}', 'says 14 faces, and holds 12')
    # The first three triangles have the corners 0 1 3, 0 3 2 and 4 6 7, so not 5.
    mesh = shape('.obj', dialects.obj(vertices, dialects.triangles(sides)[:3]))
    assert mesh.notes == ('1 of 8 vertices belong to no face',)


# What headers promise costs no memory


@pytest.mark.parametrize('form', FORMS)
@pytest.mark.parametrize('count', [10**12, 2**31, 2**62, 61])
def test_a_ply_of_a_million_million_points_is_refused(form, count):
    refused(
        '.ply', dialects.ply(xyz(POINTS), form, count=count), f'ends after 60 of {count} points'
    )


@pytest.mark.parametrize('encoding', ENCODINGS)
def test_a_pcd_of_a_million_million_points_is_refused(encoding):
    refused('.pcd', dialects.pcd(xyz(POINTS), encoding, count=10**12), '1000000000000 points')


@pytest.mark.parametrize('count', ['-60', '60.0', 'sixty', '1e3', '9' * 30])
def test_a_count_that_is_none_is_refused(count):
    refused('.ply', dialects.ply(xyz(POINTS), count=count), 'line 3')
    refused('.pcd', dialects.pcd(xyz(POINTS), count=count), 'valid is a whole number')


def test_a_face_of_four_thousand_million_corners_is_refused():
    whole = dialects.ply(xyz(POINTS), 'binary_little_endian', faces=[[0, 1, 2]])
    lying = whole.replace(b'list uchar', b'list uint')[:-13] + struct.pack('<I', 2**32 - 1)
    refused('.ply', lying + bytes(40), 'ends after 0 of 1 faces')


def test_compressed_points_whose_sizes_lie_are_refused():
    whole = dialects.pcd(xyz(POINTS), 'binary_compressed')
    start = whole.index(b'binary_compressed\n') + len(b'binary_compressed\n')
    end = start + 8
    packed, unpacked = struct.unpack_from('<II', whole, start)
    points = whole[end:]
    assert unpacked == 720

    def with_sizes(*sizes):
        return whole[:start] + struct.pack('<II', *sizes) + points

    refused('.pcd', with_sizes(packed + 1, unpacked), 'ends after .* packed bytes')
    refused('.pcd', with_sizes(packed - 1, unpacked), 'are damaged')
    refused('.pcd', with_sizes(packed, unpacked + 12), 'should unpack to 732')
    refused('.pcd', with_sizes(packed, 2**32 - 1), 'should unpack to 4,294,967,295')
    refused('.pcd', whole[: start + 3], 'ends after 0 of 60 points')


def test_a_packed_file_that_unfolds_without_end_is_refused(tmp_path):
    path = tmp_path / 'bomb.xyz.gz'
    path.write_bytes(gzip.compress(b'0 0 0\n' * (SMALL // 5), 9))
    assert path.stat().st_size < SMALL // 500
    with pytest.raises(MapError, match='unfolds to more than 64,000,000 bytes'):
        read_shape(path)


@pytest.mark.parametrize('lost', [1, 8, 9, 40])
def test_packed_files_are_read_and_cut_ones_are_refused(tmp_path, lost):
    packed = gzip.compress(dialects.ply(xyz(POINTS)))
    (tmp_path / 'CLOUD.PLY.GZ').write_bytes(packed)
    np.testing.assert_array_equal(read_shape(tmp_path / 'CLOUD.PLY.GZ').points, POINTS)
    (tmp_path / 'cut.ply.gz').write_bytes(packed[:-lost])
    with pytest.raises(MapError, match='it was cut'):
        read_shape(tmp_path / 'cut.ply.gz')


def test_what_is_no_file_is_told_apart(tmp_path):
    (tmp_path / 'folder.ply').mkdir()
    (tmp_path / 'empty.xyz').touch()
    for name, said in (
        ('folder.ply', 'a folder'),
        ('empty.xyz', 'the file is empty'),
        ('absent.ply', 'there is no such file'),
        ('map.las', r"cannot be read as '\.las'; valid are \.npz, \.ply"),
        ('map', "cannot be read as ''"),
    ):
        with pytest.raises(MapError, match=said):
            load_map(tmp_path / name)
    with pytest.raises(MapError, match='not a plain file'):
        bytes_of(type(tmp_path)('/dev/zero'))


# Types, padding, dialects


@pytest.mark.parametrize('form', FORMS)
@pytest.mark.parametrize('types', [('f8', 'f4', 'f4'), ('f4', 'f8', 'f4'), ('f8', 'f8', 'f8')])
def test_ply_properties_of_mixed_types_are_read(form, types):
    cloud = shape('.ply', dialects.ply(xyz(POINTS, types), form))
    expected = SINGLE if form != 'ascii' else POINTS
    for k, kind in enumerate(types):
        np.testing.assert_array_equal(
            cloud.points[:, k], (POINTS if kind == 'f8' else expected)[:, k]
        )


@pytest.mark.parametrize('newline', ['\n', '\r\n', '\r'])
@pytest.mark.parametrize('form', FORMS)
def test_ply_with_comments_colours_and_any_line_ends_is_read_by_name(form, newline):
    columns = {'red': ('u1', COLOURS[:, 0]), **xyz(POINTS, ('f8',) * 3)}
    columns |= {'confidence': ('f4', POINTS[:, 0])}
    data = dialects.ply(
        columns, form, newline=newline, head=['comment end_header', 'obj_info of a scanner']
    )
    cloud = shape('.ply', data)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == ('left aside: red, confidence',)


def test_a_padded_binary_pcd_as_large_lidars_write_it_is_read():
    columns = {**xyz(POINTS), '_4': ('u1', None), 'intensity': ('f4', np.ones(60))}
    columns |= {'_12': ('u1', None)}
    for encoding in ENCODINGS:
        cloud = shape('.pcd', dialects.pcd(columns, encoding))
        np.testing.assert_array_equal(cloud.points, POINTS if encoding == 'ascii' else SINGLE)
        assert cloud.notes == ('left aside: intensity',)


def test_pixels_that_saw_nothing_are_left_out_of_an_organised_pcd_and_counted():
    holes = POINTS.copy()
    holes[[3, 17, 40]] = np.nan
    for encoding in ENCODINGS:
        cloud = shape('.pcd', dialects.pcd(xyz(holes, ('f8',) * 3), encoding, width=10))
        np.testing.assert_array_equal(cloud.points, np.delete(POINTS, [3, 17, 40], axis=0))
        assert cloud.notes == ('3 of 60 points left out: they have no coordinates',)
    refused('.pcd', dialects.pcd(xyz(holes * np.nan), 'ascii'), 'holds no points')


def test_a_pcd_whose_width_and_height_are_not_its_points_is_refused():
    data = dialects.pcd(xyz(POINTS)).replace(b'HEIGHT 1', b'HEIGHT 2')
    refused('.pcd', data, 'WIDTH 60, HEIGHT 2, POINTS 60')


def test_a_viewpoint_moves_no_point_and_that_is_said():
    cloud = shape('.pcd', dialects.pcd(xyz(POINTS), viewpoint='1 2 3 1 0 0 0'))
    np.testing.assert_array_equal(cloud.points, SINGLE)
    assert cloud.notes == ('VIEWPOINT 1 2 3 1 0 0 0 moves no point: they are taken as they stand',)


def test_lzf_of_liblzf_is_unpacked():
    """
    Five bytes by hand: two as they are (control 1), then a copy of three, one back.

    Control 1 << 5 is a length of 1 + 2; a distance of 0 begins at the byte before.
    """
    header = dialects.pcd({**xyz(np.zeros((1, 3))), 'a': ('u1', np.zeros(1))}, 'binary_compressed')
    start = header.index(b'compressed\n') + len(b'compressed\n')
    packed = bytes([1, 0, 0, (1 << 5), 0, 7, *range(8)])
    cloud = shape('.pcd', header[:start] + struct.pack('<II', len(packed), 13) + packed)
    x, y, z = struct.unpack('<3f', bytes(5) + bytes(range(7)))
    np.testing.assert_array_equal(cloud.points, [[x, y, z]])


@pytest.mark.parametrize('delimiter', [' ', '\t', ',', ', ', ';', '   '])
@pytest.mark.parametrize('header', ['', 'lower', 'upper', 'quoted', 'slashes', 'hash'])
@pytest.mark.parametrize(
    ('newline', 'encoding'), [('\n', 'utf-8'), ('\r\n', 'utf-8-sig'), ('\r', 'utf-16')]
)
def test_tables_of_text_are_read_in_any_dialect(delimiter, header, newline, encoding):
    columns = dict(zip('xyz', POINTS.T, strict=True)) | {'intensity': COLOURS[:, 0]}
    if not header:
        del columns['intensity']
    said = dialects.text(columns, delimiter, header=header, newline=newline)
    cloud = shape('.csv', said.encode(encoding))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == (('left aside: intensity',) if header else ())


def test_columns_are_taken_by_their_names():
    cloud = shape('.csv', 'id;z;y;x\n7;3;2;1\n')
    np.testing.assert_array_equal(cloud.points, [[1.0, 2.0, 3.0]])
    assert cloud.notes == ('left aside: id',)


# Meaning


def test_colours_are_no_normals_and_that_is_said(tmp_path):
    columns = dict(zip('xyz', POINTS.T, strict=True)) | dict(zip('rgb', COLOURS.T, strict=True))
    path = tmp_path / 'coloured.xyz'
    path.write_text(dialects.text(columns))
    prior = load_map(path, viewpoint=[0.0, 0.0, 5.0])
    np.testing.assert_array_equal(prior.points, POINTS)
    assert 'left aside: red, green, blue' in prior.notes
    bare = tmp_path / 'bare.xyz'
    bare.write_text(dialects.text(dict(zip('xyz', POINTS.T, strict=True))))
    np.testing.assert_array_equal(load_map(bare, viewpoint=[0, 0, 5.0]).normals, prior.normals)


@pytest.mark.parametrize('scale', [255.0, 1.0])
def test_colours_from_black_to_white_are_colours_though_some_have_length_1(scale):
    colours = np.array([[1, 0, 0], [0, 0, 0], [1, 1, 1], [0.2, 0.6, 0.4]]) * scale
    rows = ''.join(f'0 {k} 2 {r:g} {g:g} {b:g}\n' for k, (r, g, b) in enumerate(colours))
    assert shape('.xyz', rows).normals is None


def test_unnamed_columns_of_length_1_are_normals_and_others_are_refused_by_name():
    rows = '0 0 0 0 0 1\n1 0 0 0.6 0 0.8\n0 1 0 -0.577 0.577 0.577\n'
    np.testing.assert_allclose(shape('.xyz', rows).normals[1], [0.6, 0.0, 0.8])
    refused('.xyz', rows + '2 2 2 0 0 0.5\n', 'some have it, some not: line 4 has length 0.5')
    refused('.xyz', '0 0 0 -3 0 1\n1 0 0 2 0 -7\n', 'none has it, and they are no colours')
    refused('.xyz', '1 2 3 4\n', '4 columns; valid are x,y,z or')
    refused('.xyz', '1 2\n', '2 columns')
    refused('.xyz', '1 2 3 4 5 6 7 8 9\n', '9 columns')


@pytest.mark.parametrize('suffix', ['.csv', '.ply', '.pcd'])
def test_named_normals_have_length_1_or_are_left_aside_or_refused(suffix):
    normals = np.tile([0.0, 0.6, 0.8], (60, 1))

    def written(normals):
        columns = xyz(POINTS, ('f8',) * 3) | {
            name: ('f8', normals[:, k]) for k, name in enumerate(('nx', 'ny', 'nz'))
        }
        if suffix == '.csv':
            return dialects.text({n: v for n, (_, v) in columns.items()}, ',', header='lower')
        return (dialects.ply if suffix == '.ply' else dialects.pcd)(columns, 'ascii')

    np.testing.assert_array_equal(shape(suffix, written(normals)).normals, normals)
    for none in (5.0 * normals, 0.0 * normals):
        cloud = shape(suffix, written(none))
        assert cloud.normals is None and 'normals left aside' in cloud.notes[0]
    normals[41] *= 0.5
    refused(suffix, written(normals), '1 of 60 normals .* first is number 41 .* length 0.5')


@pytest.mark.parametrize('names', ['nx,ny', 'nz'])
def test_a_part_of_a_normal_is_refused(names):
    values = ',1' * len(names.split(','))
    refused('.csv', f'x,y,z,{names}\n1,2,3{values}\n', f'line 1: columns x,y,z,{names}')


def test_decimal_commas_are_refused_with_line_and_field():
    columns = dict(zip('xyz', POINTS.T, strict=True))
    first = f'{POINTS[0, 0]:.4f}'.replace('.', ',')
    for delimiter in (';', ' ', '\t'):
        rows = dialects.text(columns, delimiter, comma=True)
        refused('.csv', rows, f"line 1, field 1.*'{first}' has a decimal comma")
    rows = dialects.text(columns, ',', comma=True, header='lower')
    refused('.csv', rows, f"line 2, field 1 .x.: '{first}' has a decimal comma")
    refused('.xyz', dialects.text(columns, ',', comma=True), 'line 1: .* may be three numbers')
    refused('.xyz', '1.5 2.5 3.5\n1.5 2,5 3.5\n', "line 2, field 2.*'2,5' has a decimal comma")
    head, body = dialects.ply(xyz(POINTS)).decode().split('end_header\n')
    commas = f'{head}end_header\n{body.replace(".", ",")}'
    refused('.ply', commas, r'line 8, field 1 \(x\): .* has a decimal comma')
    head, body = dialects.pcd(xyz(POINTS), 'ascii').decode().split('DATA ascii\n')
    refused(
        '.pcd', f'{head}DATA ascii\n{body.replace(".", ",")}', r'line 12, field 1 \(x\): .* comma'
    )
    vertices, sides = dialects.box([0, 0, 0], [1, 1, 1])
    commas = dialects.obj(vertices, sides).replace('.', ',')
    refused('.obj', commas, r'line 1, field 1 \(x\): .* has a decimal comma')


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('x,y,z\n1,2\n', 'line 2: expected 3 numbers'),
        ('x,y,z\n1,2,3\n4,5,6,7\n', 'line 3: expected 3 numbers'),
        ('x,y,z,x\n1,2,3,4\n', 'line 1: x is named twice'),
        ('x,y\n1,2\n', 'line 1: columns x,y; needed are x, y and z'),
        ('x [mm],y [mm],z [mm]\n1,2,3\n', 'needed are x, y and z, in metres'),
        ('x,y,z\n1,,3\n', "line 2, field 2 .y.: '' is no number"),
        ('1 2 3\n1_0 2 3\n', "line 2, field 1.*'1_0' is no number"),
        ('1 2 3\n1 2 1e400\n', 'are not finite, the first is number 1 .line 2'),
        ('1 2 3\n1 2 1e12\n', '1 of 2 points are more than 1e.09 from 0'),
        ('# nothing\n\n', 'holds no points'),
        ('\0\1\2', 'not a text file'),
    ],
)
def test_tables_that_cannot_be_meant_are_refused(text, said):
    refused('.csv', text, said)


# Meshes


def three_boxes(write):
    """Boxes 1 m wide and 2 m apart, as the parts of one file."""
    return ''.join(write(*dialects.box([2.0 * k, 0, 0], [1, 1, 1])) for k in range(3))


def test_relative_indices_count_from_the_vertex_before_the_face():
    text = three_boxes(lambda v, sides: dialects.obj(v, dialects.triangles(sides), relative=True))
    mesh = shape('.obj', text)
    assert mesh.vertices.shape == (24, 3) and mesh.faces.shape == (36, 3)
    used = mesh.vertices[mesh.faces]
    assert (used[..., 0].min(), used[..., 0].max()) == (0.0, 5.0)
    for k in range(3):
        part = used[range(12 * k, 12 * k + 12), :, 0]
        assert (part.min(), part.max()) == (2.0 * k, 2.0 * k + 1.0)


@pytest.mark.parametrize('slash', ['', '/1', '//1', '/1/1'])
@pytest.mark.parametrize('relative', [False, True])
def test_obj_faces_of_any_form_are_cut_into_triangles(slash, relative):
    vertices, sides = dialects.box([0, 0, 0], [1, 2, 3])
    extra = 'o part\ng side\nusemtl steel\ns off\nvt 0 0\nvn 0 0 1\n'
    mesh = shape('.obj', extra + dialects.obj(vertices, sides, relative=relative, slash=slash))
    np.testing.assert_array_equal(mesh.faces, dialects.triangles(sides))
    np.testing.assert_array_equal(mesh.vertices, vertices)
    assert mesh.notes == ('6 polygons cut into triangles',)


def test_obj_vertices_may_have_colours_or_a_weight_of_1():
    faces = 'f 1 2 3\n'
    rows = 'v 0 0 0{0}\nv 1 0 0{0}\nv 0 1 0{0}\n'
    coloured = shape('.obj', rows.format(' 0.5 0.5 0.5') + faces)
    np.testing.assert_array_equal(coloured.vertices[1], [1.0, 0.0, 0.0])
    assert coloured.notes == ('colours left aside',)
    assert shape('.obj', rows.format(' 1.0') + faces).notes == ()
    refused('.obj', rows.format(' 2.0') + faces, 'weights')


@pytest.mark.parametrize(
    ('face', 'said'),
    [
        ('f 1 2 9', 'line 9: a face names vertex 9, there are 8'),
        ('f 0 1 2', "line 9: '0' names no vertex"),
        ('f -1 -2 -9', "line 9: '-9' names no vertex"),
        ('f 1 2', 'line 9: a face of 2 corners'),
        ('f 1.0 2 3', "line 9: '1.0' names no vertex"),
        ('f one 2 3', "line 9: 'one' names no vertex"),
        ('', 'holds no faces'),
    ],
)
def test_obj_faces_without_their_vertices_are_refused(face, said):
    vertices, _ = dialects.box([0, 0, 0], [1, 1, 1])
    refused('.obj', dialects.obj(vertices, []) + face + '\n', said)


@pytest.mark.parametrize('form', FORMS)
def test_ply_meshes_of_polygons_are_read(form):
    vertices, sides = dialects.box([0, 0, 0], [1, 2, 3])
    mixed = [*sides[:3], *dialects.triangles(sides[3:])]
    mesh = shape('.ply', dialects.ply(xyz(vertices), form, faces=mixed))
    np.testing.assert_array_equal(mesh.faces, dialects.triangles(mixed))
    np.testing.assert_array_equal(mesh.vertices, vertices)
    whole = dialects.ply(xyz(vertices), form, faces=mixed)
    refused(
        '.ply', cut_rows(whole, 1) if form == 'ascii' else whole[:-3], 'ends after 8 of 9 faces'
    )
    refused('.ply', dialects.ply(xyz(vertices), form, faces=[[0, 1, 8]]), 'there are 8')
    refused('.ply', dialects.ply(xyz(vertices), form, faces=[[0, 1]]), 'has 2 corners')


# Any cut, any dialect


def packed_npz(tmp_path_factory):
    path = tmp_path_factory.mktemp('own') / 'map.npz'
    PriorMap(POINTS, np.tile([0, 0, 1.0], (60, 1)), np.ones(60)).save(path)
    return path


def test_our_own_map_cut_anywhere_is_refused(tmp_path_factory):
    path = packed_npz(tmp_path_factory)
    whole = path.read_bytes()
    for length in {*range(0, len(whole), 37), *range(len(whole) - 120, len(whole))}:
        path.write_bytes(whole[:length])
        with pytest.raises(MapError, match='map.npz: '):
            load_map(path)


coordinates = st.integers(-(10**7), 10**7).map(lambda number: number / 1e4)
clouds = st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=8)


@st.composite
def written_clouds(draw):
    """(suffix, bytes, the points that these hold, whether the file says how many)."""
    points = np.array(draw(clouds))
    types = draw(st.tuples(*[st.sampled_from(['f4', 'f8'])] * 3))
    newline = draw(st.sampled_from(['\n', '\r\n']))
    columns = xyz(points, types)
    if draw(st.booleans()):
        columns |= {'red': ('u1', np.arange(len(points)) % 200)}
    stored = np.column_stack([points[:, k].astype(kind) for k, kind in enumerate(types)])
    suffix = draw(st.sampled_from(['.ply', '.pcd', '.xyz', '.pts']))
    if suffix == '.ply':
        form = draw(st.sampled_from(FORMS))
        data = dialects.ply(columns, form, newline=newline)
        return suffix, data, points if form == 'ascii' else stored.astype(float), True
    if suffix == '.pcd':
        encoding = draw(st.sampled_from(ENCODINGS))
        data = dialects.pcd(columns, encoding, newline=newline)
        return suffix, data, points if encoding == 'ascii' else stored.astype(float), True
    plain = dict(zip('xyz', points.T, strict=True))
    delimiter = draw(st.sampled_from([' ', '\t', ',', ';', ', ']))
    decimals = draw(st.integers(4, 6))
    before = [str(len(points))] if suffix == '.pts' else []
    header = draw(st.sampled_from(['', 'lower', 'hash'])) if suffix == '.xyz' else ''
    data = dialects.text(
        plain, delimiter, newline=newline, decimals=decimals, before=before, header=header
    )
    return suffix, data.encode(), points, suffix == '.pts'


@settings(max_examples=300, deadline=None)
@given(written_clouds(), st.data())
def test_a_cloud_cut_anywhere_gives_its_own_points_or_an_error(cloud, data):
    """A table that does not say how many points it has may end between two of them."""
    suffix, whole, points, counted = cloud
    np.testing.assert_array_equal(shape(suffix, whole).points, points)
    cut = data.draw(st.integers(0, len(whole) - 1))
    try:
        read = shape(suffix, whole[:cut]).points
    except MapError:
        return
    np.testing.assert_array_equal(read, points[: len(read)])
    assert len(read) == len(points) or not counted


@st.composite
def written_meshes(draw):
    """(suffix, bytes, the triangles (F, 3, 3) that these hold, whether the file says how many)."""
    vertices, sides = dialects.box(
        draw(st.tuples(coordinates, coordinates, coordinates)), [1.5, 2.25, 0.125]
    )
    vertices = np.concatenate([vertices, vertices + 4.0]).round(4)
    faces = [*sides, *([index + 8 for index in side] for side in sides)]
    if draw(st.booleans()):
        faces = dialects.triangles(faces)
    corners = vertices[np.array(dialects.triangles(faces))]
    kind = draw(st.sampled_from(['.obj', '.stl', 'ascii.stl', *FORMS]))
    if kind == '.obj':
        slash = draw(st.sampled_from(['', '/1', '//1']))
        return kind, dialects.obj(vertices, faces, slash=slash).encode(), corners, False
    if kind == '.stl':
        return kind, dialects.stl(corners), corners.astype(np.float32).astype(float), True
    if kind == 'ascii.stl':
        return '.stl', dialects.ascii_stl(corners).encode(), corners, True
    data = dialects.ply(xyz(vertices, ('f8',) * 3), kind, faces=faces)
    return '.ply', data, corners, True


@settings(max_examples=200, deadline=None)
@given(written_meshes(), st.data())
def test_a_mesh_cut_anywhere_gives_its_own_triangles_or_an_error(mesh, data):
    suffix, whole, corners, counted = mesh
    read = shape(suffix, whole)
    np.testing.assert_array_equal(read.vertices[read.faces], corners)
    cut = data.draw(st.integers(0, len(whole) - 1))
    try:
        read = shape(suffix, whole[:cut])
    except MapError:
        return
    np.testing.assert_array_equal(read.vertices[read.faces], corners[: len(read.faces)])
    assert len(read.faces) == len(corners) or not counted


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(READERS)), st.binary(max_size=300))
def test_any_bytes_are_a_shape_or_an_error(suffix, data):
    heads = {'.ply': b'ply\n', '.pcd': b'FIELDS x y z\n', '.stl': b'solid\n'}
    for content in (data, heads.get(suffix, b'') + data):
        try:
            shape(suffix, content)
        except MapError as error:
            assert str(error).startswith(f'part{suffix}')


@settings(max_examples=200, deadline=None)
@given(written_clouds(), st.data())
def test_any_changed_bytes_are_points_or_an_error(cloud, data):
    """Neither a crash nor an error of another kind, whatever a transmission did."""
    suffix, whole, _, _ = cloud
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    try:
        assert np.isfinite(shape(suffix, bytes(damaged)).points).all()
    except MapError as error:
        assert str(error).startswith(f'part{suffix}')


# Nothing takes its time from what a header says


def test_a_field_of_a_million_million_values_is_refused():
    for encoding in ENCODINGS:
        data = dialects.pcd({**xyz(POINTS), 'h': ('f4', np.ones(60))}, encoding)
        lying = data.replace(b'COUNT 1 1 1 1', b'COUNT 1 1 1 1000000000000')
        refused('.pcd', lying, 'ends after 0 of 60 points|60 points, which are')


def test_a_row_of_a_million_columns_is_refused():
    refused('.xyz', '1 ' * 1_000_000 + '\n', 'line 1: 1000000 columns; at most 1000 are read')
    refused(
        '.csv', ','.join(f'c{k}' for k in range(10_000)) + '\n1,2,3\n', 'line 1: columns c0,c1'
    )


def test_a_file_larger_than_the_memory_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / 'sparse.ply'
    with path.open('wb') as stream:
        try:
            stream.truncate(10**13)  # a sparse file: no such space is taken
        except OSError:
            stream.truncate(10**12)  # as much as a file system takes
    with pytest.raises(MapError, match=r'sparse\.ply: does not fit into memory'):
        load_map(path)


def test_of_very_many_wrong_lines_the_first_is_told_and_not_all_are_counted():
    refused('.xyz', '1 2 3\n' * 20_000 + '1 x 3\n' * 20_000, 'line 20001, .*more than 1000 such')


@pytest.mark.parametrize('suffix', ['.ply', '.pcd', '.stl', '.obj'])
def test_a_byte_order_mark_before_a_text_format_is_no_part_of_it(suffix):
    vertices, sides = dialects.box([0, 0, 0], [1, 1, 1])
    text = {
        '.ply': dialects.ply(xyz(vertices)),
        '.pcd': dialects.pcd(xyz(vertices), 'ascii'),
        '.stl': dialects.ascii_stl(vertices[np.array(dialects.triangles(sides))]).encode(),
        '.obj': dialects.obj(vertices, sides).encode(),
    }[suffix]
    plain, marked = shape(suffix, text), shape(suffix, b'\xef\xbb\xbf' + text)
    assert marked.notes == plain.notes
    for name in ('points', 'vertices', 'faces'):
        if hasattr(plain, name):
            np.testing.assert_array_equal(getattr(marked, name), getattr(plain, name))
