from sw_wisp import numbers


def test_groups_follow_one_another_without_gaps():
    ends = [0, *(group.columns.stop for group in numbers.GROUPS)]
    assert [group.columns.start for group in numbers.GROUPS] == ends[:-1]
    assert all(group.columns.stop - group.columns.start == group.width for group in numbers.GROUPS)


def test_a_splat_has_22_numbers_in_coding_order():
    assert numbers.NUMBERS == len(numbers.BASE_STEPS) == len(numbers.LIMITS) == 22
    assert [group.name for group in numbers.GROUPS] == ["opacity", "shape", "size", "colour", "latents"]
    assert numbers.BASE_STEPS[7:10] == (0.05, 0.07, 0.07)
