"""Random worlds for the training pictures: what stands where, what it is made of, and how a camera sees it.

Built on the solids and the ray caster of the synthetic drives, but for looking at only: no two worlds share a colour or texture.
Lengths are in metres, angles in rad, colours BGR with light and albedo from 0 to 1.
"""
