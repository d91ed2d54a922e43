"""What a rod or an assembly is: strain bases, sections, links, joints."""
