"""Small files of control in the forms of several programs: synthetic, after their documentation."""

GCP_LIST = """EPSG:32633
386800.10 6175000.20 30.5 1012.5 800.25 DJI_0001.JPG G1
386800.10 6175000.20 30.5 512.5 810.25 DJI_0002.JPG G1 extra
386900.00 6175100.00 nan 99.5 0.0 DJI_0001.JPG G2
386950.25\t6175050.75\t31.0\t640.0\t480.0\tDJI_0002.JPG
386950.25 6175050.75 31.0 641.0 481.0 DJI_0003.JPG
"""
MARKERS = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.2.0">
  <chunk>
    <cameras next_id="2">
      <camera id="0" label="DJI_0001.JPG" sensor_id="0"/>
      <group id="0" label="rest"><camera id="1" label="DJI_0002.JPG" sensor_id="0"/></group>
    </cameras>
    <markers>
      <marker id="7" label="point 1">
        <reference x="13.2001" y="55.7001" z="30.5" sx="0.01" sy="0.01" sz="0.02" enabled="true"/>
      </marker>
      <marker id="8" label="point 2"><reference x="13.2011" y="55.7002" z="31.5" sxyz="0.005" enabled="false"/></marker>
      <marker id="9" label="tie"/>
    </markers>
    <reference>GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]</reference>
    <frames>
      <frame id="0">
        <markers>
          <marker marker_id="7">
            <location camera_id="0" pinned="true" x="100.25" y="200.5"/>
            <location camera_id="1" pinned="false" x="1.0" y="2.0"/>
          </marker>
          <marker marker_id="8"><location camera_id="1" pinned="true" x="300.0" y="400.0"/></marker>
          <marker marker_id="9"><location camera_id="1" pinned="true" x="30.0" y="40.0"/></marker>
        </markers>
      </frame>
    </frames>
  </chunk>
</document>
"""  # noqa: E501
REFERENCE = """#CoordinateSystem: PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32633"]]
#Label,Enable,X/Easting,Y/Northing,Z/Altitude,Accuracy_X_(m),Accuracy_Y_(m),Accuracy_Z_(m),Error_(m)
G1,1,386800.10,6175000.20,30.5,0.01,0.01,0.02,0.5
G2,0,386900.00,6175100.00,31.5,,,,
"""  # noqa: E501
PIX4D = """GCP0,55.70011,13.20022,29.931,0.02,0.03
GCP1,55.70111,13.20122,29.823,0.02,0.03
"""
PIX4D_MARKS = """D:/flight/DJI_0001.JPG,GCP0,100.5,200.25,1.0
D:/flight/DJI_0002.JPG,GCP0,110.5,210.25,0.5
D:/flight/DJI_0002.JPG,GCP1,10.5,20.25,0.5
"""
OWN = """# EPSG:32633
point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role
G1,386800.10,6175000.20,30.5,0.01,0.01,0.02,control
G2,386900.00,6175100.00,,0.01,0.01,,check
"""
OWN_MARKS = """image;point;x_px;y_px;sigma_px
DJI_0001;G1;100,25;200,5;0,1
DJI_0002;G1;110,25;210,5;
"""
